"""Links between photos: matches of their keypoints, by which the pose of one follows from that of another.

Two photos alone show little of how a camera turned and moved between them: a short way hardly differs from a
turn, and a wall has two solutions. The scan has the depth that the photos lack. If a photo is supposed to be
at a pose, its keypoints get their ranges from the scan there. Their matches with the keypoints of another
photo then give the other photo's pose by P3P, and so on from photo to photo.
"""

import itertools
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evidence.verification import find_ranges
from ..geometry.pose import Pose, rotate_points
from ..geometry.sphere import compute_indices
from ..local_features.hypotheses import count_inliers, propose_poses
from ..local_features.keypoints import Keypoints
from ..local_features.matching import Located, Matches, match_pictures, merge_matches, pair
from ..problem.problem import Problem
from ..system.arrays import Array32
from ..system.jobs.threads import Workers
from .relation import Relation, relate

LEAST_LINKED = 6  # matches of two photos that may show the same
LEAST_BRIDGE = 5  # matches that agree with the poses of two photos that were placed separately
NUM_PROPOSED = 4  # poses by matches, of which the first that is allowed counts
MOST_EACH = 40  # chosen: photos; if there are more, each is matched only with those that look most like it
NUM_LIKE = 20  # chosen: photos that look most like one
NUM_LARGEST = 64  # chosen: keypoints of a photo by which the photos like it are found
Pair = tuple[NDArray[np.intp], NDArray[np.intp]]  # keypoints (M,) of a photo, and of another


class Trust(NamedTuple):
    """Limits within which the matches of a photo place it."""

    least: int  # number of matches that agree with a pose, at least
    reach: float  # [m] from the nearest photo with which it is matched, at most


FIRM = Trust(12, math.inf)  # for any photos: in repeated patterns, as of ceilings, 8 matches agree by chance
WEAK = Trust(6, 1.0)  # for photos that were taken at one spot


class Placed(NamedTuple):
    """A photo at a supposed pose in the map."""

    pose: Pose
    ranges: Array32  # (N,) [m] of its keypoints, by the scan; 0 for those that the scan does not explain


Places = Mapping[int, Placed]  # of photos, by their numbers


@dataclass(frozen=True)
class Links:
    """Photos, by their numbers, and which of their keypoints match."""

    problems: Mapping[int, Problem]
    keypoints: Mapping[int, Keypoints]
    pairs: Mapping[tuple[int, int], Pair]
    workers: Workers

    def list_linked(self, number: int) -> list[int]:
        """List the photos that may show the same as one."""
        return [other for own, other in self.pairs if own == number]

    def list_groups(self) -> list[list[int]]:
        """List the groups of photos that are linked, directly or by way of others; each in order."""
        left = sorted(self.problems)
        groups = []
        while left:
            group = left[:1]
            for number in group:
                group += [other for other in self.list_linked(number) if other not in group]
            groups.append(sorted(group))
            left = [number for number in left if number not in group]
        return groups

    def place(self, number: int, pose: Pose) -> Placed:
        """Return a photo as it is if it was taken at a pose."""
        return Placed(pose, find_ranges(self.problems[number], pose, self.workers))

    def match(self, number: int, places: Places) -> dict[int, Matches]:
        """Return the matches of a photo with each of those placed ones that are linked with it."""
        matches = {}
        for other in (other for other in self.list_linked(number) if other in places):
            pose, ranges = places[other]
            mine, theirs = self.pairs[number, other]
            is_seen = ranges[theirs] > 0.0
            located = Located(self.keypoints[other], ranges, pose)
            matches[other] = pair(self.keypoints[number], mine[is_seen], located, theirs[is_seen])
        return matches


def find_links(problems: Mapping[int, Problem], workers: Workers) -> Links:
    """Match the photos with each other; if they are many, each with those that look most like it."""
    keypoints = {number: problem.photo.features(workers).keypoints for number, problem in problems.items()}
    return Links(problems, keypoints, match_each(keypoints, workers), workers)


def match_each(keypoints: Mapping[int, Keypoints], workers: Workers) -> dict[tuple[int, int], Pair]:
    """Return the matches of those photos that may show the same, both ways."""
    asked = list_pairs(keypoints, workers)
    found = workers.map(lambda two: match_two(keypoints[two[0]], keypoints[two[1]]), asked, "match")
    pairs: dict[tuple[int, int], Pair] = {}
    for (one, other), (mine, theirs) in zip(asked, found, strict=True):
        if len(mine) >= LEAST_LINKED:
            pairs[one, other] = mine, theirs
            pairs[other, one] = theirs, mine
    return pairs


def list_pairs(keypoints: Mapping[int, Keypoints], workers: Workers) -> list[tuple[int, int]]:
    """List the pairs of photos to be matched: all, or if many those whose largest keypoints match best."""
    every = list(itertools.combinations(sorted(keypoints), 2))
    if len(keypoints) <= MOST_EACH:
        return every
    largest = {
        number: one.take(np.argsort(-one.sizes, kind="stable")[:NUM_LARGEST])
        for number, one in keypoints.items()
    }
    counts = workers.map(
        lambda two: len(match_pictures(largest[two[0]], largest[two[1]])[0]), every, "compare photos"
    )
    like: dict[int, list[tuple[int, tuple[int, int]]]] = {number: [] for number in keypoints}
    for two, count in zip(every, counts, strict=True):
        for number in two:
            like[number].append((-count, two))
    return sorted({two for ranked in like.values() for _, two in sorted(ranked)[:NUM_LIKE]})


def match_two(one: Keypoints, other: Keypoints) -> Pair:
    """Return the keypoints of two photos that match; none if one of them has more matches when mirrored."""
    mine, theirs = match_pictures(one, other)
    if len(mine) >= LEAST_LINKED and len(match_pictures(one.mirror(), other)[0]) > len(mine):
        return mine[:0], theirs[:0]
    return mine, theirs


def spread(links: Links, anchors: Places, numbers: Collection[int], trust: Trust) -> Places:
    """Place photos that are linked with anchors, and those that are linked with these, and so on.

    The photo with the most matches comes first; one that can't be placed is tried again when more photos that
    it is linked with are placed.
    """
    places = dict(anchors)
    tried = set[tuple[int, int]]()  # with the number of photos that it was matched with
    while True:
        asked = {number: links.match(number, places) for number in numbers if number not in places}
        counts = {
            number: sum(len(matches.query) for matches in parts.values())
            for number, parts in asked.items()
            if (number, len(parts)) not in tried
        }
        number = max(counts, key=counts.__getitem__, default=None)
        if number is None or counts[number] < trust.least:
            return places
        tried.add((number, len(asked[number])))
        near = [places[other].pose for other in asked[number]]
        found = find_pose(asked[number].values(), near, trust, links.workers)
        if found is not None:
            places[number] = links.place(number, found.pose)


def find_pose(
    matches: Iterable[Matches], near: Collection[Pose], trust: Trust, workers: Workers
) -> Relation | None:
    """Return a photo's pose by its matches with others, whose poses are `near`; None if too few agree."""
    merged = merge_matches(list(matches))
    proposed = propose_poses(merged, NUM_PROPOSED, workers)
    for pose in (one.pose for one in proposed if one.num_matches >= trust.least):
        if min(pose.distance(other) for other in near) <= trust.reach:
            return relate(merged, pose)
    return None


def are_bridged(links: Links, one: Places, other: Places) -> bool:
    """Return True if matches between photos that were placed apart agree with both."""
    if one.keys() & other.keys():
        return False
    counts = (
        count_inliers(matches, placed.pose)
        for number, placed in one.items()
        for matches in links.match(number, other).values()
    )
    return max(counts, default=0) >= LEAST_BRIDGE


def compute_new(links: Links, places: Places, number: int) -> float:
    """Return the share of a photo's content that no other of several photos shows; 1 if nothing is known."""
    pose, ranges = places[number]
    is_seen = ranges > 0.0
    if not is_seen.any():
        return 1.0
    rays = links.keypoints[number].rays[is_seen].astype(np.float64)
    points = pose.center_world + ranges[is_seen, None] * rotate_points(rays, pose.R_cam_from_world.T)
    is_new = np.ones(len(points), bool)
    for other, at in places.items():
        if other != number:
            offsets = rotate_points(points - at.pose.center_world, at.pose.R_cam_from_world)
            distances = np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-9)
            is_valid = links.problems[other].photo.panorama.is_valid
            is_new &= ~is_valid[compute_indices(offsets / distances, is_valid.shape[1])]
    return float(is_new.mean())
