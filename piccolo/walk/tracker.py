"""Tracking of a camera through a scan, frame by frame, from past frames only."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..confidence.alternatives import MIN_ANGLE, MIN_DISTANCE, Hypothesis, sort_by_score, suppress_near
from ..confidence.confidence import posterior
from ..geometry.pose import Pose, exp_so3, log_so3, pose_errors
from ..geometry.rotations import Gravity
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..localization.attempts import FIRST_BEAM, MIRROR_RATIO, brief_query, score_mirror, score_starts
from ..localization.comparison import score_pose
from ..localization.covariance import estimate_covariance
from ..localization.localize import localize
from ..localization.prior import apply_prior
from ..localization.query import Cache, Query, prepare_query
from ..localization.refinement import (
    FULL_LOSS,
    Limits,
    descend,
    descend_fine,
    descend_middle,
    perturb_middle,
    refine,
)
from ..localization.search import search_poses
from ..localization.selection import CLEAR_SCORE, assess_poses, rank
from ..localization.settings import CoarseToFineSettings
from ..panorama import Panorama
from ..scan_map.prior import Prior
from ..scan_map.scan_map import ScanMap
from .frames import (
    MAX_STEP,
    NO_ACCELERATION,
    OTHER_LOG_ODDS,
    Frame,
    Motion,
    State,
    list_states,
    log_ratio,
    state_centers,
)
from .free_space import FreeSpace
from .path import REACH_SLACK, Lattice

LEAST_SCORE = 0.2  # of a frame that is tracked
LEAST_KEPT = 0.6  # of the score of the frame before
MOST_LISTED = 12  # poses of a frame
KEPT_BESIDE = 0.4  # of the best score: copies of a place are kept until the walk tells them apart
LAST_LIMITS = Limits(FULL_LOSS, 10, 1e-5)  # of the last descent, as in refinement
MOST_TRACKED = 6  # poses from which a frame is tracked
MOST_SOUGHT = 3  # of those at which it is not, around which it is looked for
LEAST_WEIGHT = 0.02  # of such a pose, by the likeliest
MAX_RADIUS = 12.0  # [m] around its last pose in which a lost camera is looked for
FIRST_SEARCH = 3  # frames after which a lost camera is searched everywhere
LAST_SEARCH = 48  # and again, at the latest
SHORT = 1.5  # [m] that a camera may have gone: a descent from there does not end in a neighbouring minimum
FAR = 3.0  # [m] from frame to frame, where each is searched in the whole scan
USUAL = 0.95  # of the score of the frame before
SURE = 0.9
CHECKED_SURE = 8.0  # [m] walked, after which the whole scan is searched
CHECKED_UNSURE = 4.0


class Follower(NamedTuple):
    """A state from which the next frame is predicted."""

    state: State
    time: float
    earlier: Pose | None = None
    earlier_time: float = 0.0


class Tracker:
    """The forward half of a walk: it uses past frames only, and keeps their poses."""

    def __init__(
        self,
        scan_map: ScanMap,
        settings: CoarseToFineSettings,
        workers: Workers,
        motion: Motion,
        space: FreeSpace | None = None,
    ) -> None:
        self.scan_map: ScanMap = apply_prior(scan_map, settings.prior)
        self.settings = settings
        self.workers = workers
        self.motion: Motion = motion
        self.lattice: Lattice = Lattice(space or FreeSpace(scan_map, workers), motion)
        self.num_lost: int = 0
        self.next_search: int = 1
        self.walked: float = 0.0  # [m] since the whole scan was searched
        self.is_sure: bool = False

    @property
    def frames(self) -> list[Frame]:
        """Frames so far."""
        return self.lattice.frames

    def forget_times(self) -> None:
        """Use the numbers of frames as times, as only their order is known.

        Call it before the first frame.
        """
        step = MAX_STEP if self.motion.is_guess else self.motion.max_speed
        self.motion = replace(self.motion, max_speed=step, max_acceleration=NO_ACCELERATION, is_timed=False)
        self.lattice = Lattice(self.lattice.space, self.motion)

    def prepare(self, panorama: Panorama) -> Query:
        """Prepare the query of a frame, with the images that its descents need."""
        query = prepare_query(panorama, self.scan_map, self.settings, self.workers)
        for image in query.photo.images:
            image()
        return query

    @one_blas_thread
    def add(self, panorama: Panorama, query: Query, time: float) -> Frame:
        """Localize the next frame, whose query is prepared."""
        frame = Frame(time)
        if panorama.is_valid.any() and len(self.scan_map.centers) > 0:
            is_far = bool(self.frames) and self.motion.max_speed * (time - self.frames[-1].time) >= FAR
            self._follow(query, frame, not is_far)
            is_lost = self.num_lost + 1 >= self.next_search
            is_due = self.walked + self._distance_moved(frame) >= (
                CHECKED_SURE if self.is_sure else CHECKED_UNSURE
            )
            if is_far or (is_lost and not frame.is_credible):
                self._search(query, panorama, frame)
            elif is_due and frame.is_credible:
                self._check(query, frame)
        self.accept(frame)
        return frame

    def accept(self, frame: Frame) -> None:
        """Add a frame that was localized now or earlier."""
        self.walked += self._distance_moved(frame)
        self.lattice.add(frame)
        if frame.how == "alone":
            self.walked = 0.0
        if frame.is_credible:
            self.num_lost = 0
            self.next_search = FIRST_SEARCH
            self.is_sure = bool(self.lattice.filter_last().max() >= SURE)
            return
        self.num_lost += 1
        if frame.how == "alone":
            self.next_search = self.num_lost + min(max(self.num_lost, FIRST_SEARCH), LAST_SEARCH)

    def _distance_moved(self, frame: Frame) -> float:
        """Return the distance [m] from the nearest pose of the frame before; 0 if either has none."""
        before = next((f for f in reversed(self.frames) if f.states), None)
        if before is None or not frame.states:
            return 0.0
        best = max(frame.states, key=lambda state: state.log_odds).pose.center_world
        return float(np.linalg.norm(state_centers(before.states) - best, axis=1).min())

    def _follow(self, query: Query, frame: Frame, looks_near: bool) -> None:
        """Descend from the predictions of the last poses; search near them if that fails."""
        followers = self.followers()
        if not followers:
            return
        ends = follow_all(query, followers, frame.time, self.motion)
        is_there = any(end.score >= least_score(f) for f, end in zip(followers, ends, strict=True))
        least = KEPT_BESIDE * max(end.score for end in ends) if is_there else CLEAR_SCORE
        found = [end for end in ends if end.score >= least] if is_there else []
        lost = [f for f, end in zip(followers, ends, strict=True) if not is_there or end.score < least]
        for f in lost[:MOST_SOUGHT] if looks_near else []:
            radius = self.motion.max_speed * (frame.time - f.time) + REACH_SLACK
            if radius <= MAX_RADIUS:
                found += find_near(query, f.state.pose, radius, least)
        if found:
            frame.put(make_states(query, found), "tracked" if is_there else "near")

    def followers(self) -> list[Follower]:
        """Return the poses to track from: those of the last credible frame, then of a later one."""
        known = [k for k, frame in enumerate(self.frames) if frame.states]
        credible = [k for k in known if self.frames[k].is_credible][-1:]
        later = [k for k in known[-1:] if k not in credible]
        return [f for k in (*credible, *later) for f in self._followers_of(k, known)][:MOST_TRACKED]

    def _followers_of(self, k: int, known: list[int]) -> list[Follower]:
        """Return the poses of a frame, the likeliest first."""
        last = self.frames[k]
        weights = self.lattice.forward[k]
        earlier = next((self.frames[m] for m in reversed(known) if m < k), None)
        order = [int(i) for i in np.argsort(-weights, kind="stable")]
        order = [i for i in order if weights[i] > weights.max() + np.log(LEAST_WEIGHT)]
        return [self._follower(last, last.states[i], earlier) for i in order]

    def _follower(self, last: Frame, state: State, earlier: Frame | None) -> Follower:
        if earlier is not None and earlier.states:
            gaps = [np.linalg.norm(s.pose.center_world - state.pose.center_world) for s in earlier.states]
            k = int(np.argmin(gaps))
            if gaps[k] <= self.motion.max_speed * (last.time - earlier.time) + REACH_SLACK:
                return Follower(state, last.time, earlier.states[k].pose, earlier.time)
        return Follower(state, last.time)

    def _check(self, query: Query, frame: Frame) -> None:
        """Search the whole scan for a frame that was tracked."""
        found = find_everywhere(query, CLEAR_SCORE)
        if found:
            frame.put(merge_states(query, frame.states, found), "alone")

    def _search(self, query: Query, panorama: Panorama, frame: Frame) -> None:
        """Search the whole scan, and keep the tracked poses too."""
        alone = localize(self.scan_map, panorama, self.settings, self.workers, Stopwatch())
        tracked_to = [Hypothesis(state.pose, state.score) for state in frame.states]
        states = list_states(self.scan_map, alone)
        frame.put(merge_states(query, states, tracked_to) if states else frame.states, "alone")
        frame.alone = alone


def merge_states(query: Query, states: list[State], others: Sequence[Hypothesis]) -> list[State]:
    """Merge other poses into the states of a frame."""
    for other in others:
        more = associate(query, states, other)
        states = states if more is None else [*states, more]
    return states


def least_score(f: Follower) -> float:
    """Return the least score with which a frame counts as tracked."""
    return max(LEAST_SCORE, LEAST_KEPT * f.state.score)


def follow_all(query: Query, followers: Sequence[Follower], time: float, motion: Motion) -> list[Hypothesis]:
    """Track a frame from several poses in parallel; the query's images must be made."""
    return list(query.workers.map(lambda f: follow(query, f, time, motion), followers, "descend"))


def follow(query: Query, f: Follower, time: float, motion: Motion) -> Hypothesis:
    """Descend from a predicted pose; in a larger basin if it may be far off, or scores lower."""
    least = least_score(f)
    seconds = time - f.time
    starts = [f.state.pose]
    span = f.time - f.earlier_time
    if f.earlier is not None and span != 0.0:
        reach = motion.max_speed * abs(seconds) + REACH_SLACK
        starts.insert(0, predict(f.state.pose, f.earlier, seconds / span, reach))
    end = track(query, starts[0], least)
    if end.score < least:
        end = max([end, *(track(query, start, least) for start in starts[1:])], key=lambda h: h.score)
    is_usual = end.score >= USUAL * f.state.score and motion.max_speed * abs(seconds) < SHORT
    return end if is_usual or end.score < least else track_on(query, end)


def predict(before: Pose, earlier: Pose, ratio: float, max_distance: float) -> Pose:
    """Predict a camera's pose at constant velocity from an earlier pose and the last.

    `ratio` is the time since the last pose divided by the time between the two. The prediction is at most
    `max_distance` [m] away.
    """
    move = ratio * (before.center_world - earlier.center_world)
    length = float(np.linalg.norm(move))
    move *= min(1.0, max_distance / max(length, 1e-9))
    turn = ratio * log_so3(before.R_cam_from_world @ earlier.R_cam_from_world.T)
    return Pose(exp_so3(turn) @ before.R_cam_from_world, before.center_world + move)


def track(query: Query, start: Pose, least_score: float) -> Hypothesis:
    """Descend from a predicted pose; perturb it if the end has less than the least score."""
    near = descend_fine(query, descend_middle(query, start).pose)
    if near.score < least_score:
        around = descend_fine(query, perturb_middle(query, near.pose).pose)
        near = max(near, around, key=lambda fit: fit.score)
    end = descend_last(query, near.pose)
    if end.score >= least_score:
        return end
    return max(end, score_pose(query, near.pose), key=lambda h: h.score)


def track_on(query: Query, end: Hypothesis) -> Hypothesis:
    """Perturb a tracked pose and descend again; return the better of the two."""
    around = descend_last(query, descend_fine(query, perturb_middle(query, end.pose).pose).pose)
    return max(end, around, key=lambda h: h.score)


def descend_last(query: Query, pose: Pose) -> Hypothesis:
    """Descend on the points themselves, and score the end by comparison with the photo."""
    pose = descend(query.points_at(pose), query.photo.images.full(), pose, LAST_LIMITS)
    return score_pose(query, pose)


def find_near(query: Query, near: Pose, radius: float, least_score: float) -> list[Hypothesis]:
    """Search by whole views within a radius [m]; return poses of at least a score."""
    x, y, z = (float(value) for value in query.scan_map.to_world(near).center_world)
    some = apply_prior(query.scan_map, Prior(near_world=(x, y, z), radius=radius))
    if len(some.sparse) == 0:
        return []
    close = find_everywhere(replace(query, scan_map=some, cache=Cache(query.cache.views)), least_score)
    least = KEPT_BESIDE * max((h.score for h in close), default=0.0)
    ends = query.workers.map(lambda h: track(query, h.pose, least), close, "descend")
    return [end for end in ends if end.score >= least]


def find_everywhere(query: Query, least_score: float) -> list[Hypothesis]:
    """Search the whole map by whole views; return poses and their copies, to centimetres, best first.

    Empty if the best has less than the least score.
    """
    first = brief_query(replace(query, num_parts=0))
    gravity: Gravity = "unknown" if query.settings.gravity == "unknown" else "known"
    starts = search_poses(first, gravity)
    score = score_starts(first, starts)
    if score < least_score or score < MIRROR_RATIO * score_mirror(first):
        return []
    found = rank(refine(first, starts, FIRST_BEAM), MOST_LISTED - 1)
    if found.best.score < least_score:
        return []
    least = KEPT_BESIDE * found.best.score
    return [h for h in (found.best, *found.alternatives) if h.score >= least]


def make_states(query: Query, hypotheses: Sequence[Hypothesis]) -> list[State]:
    """Make the states of a frame from its poses, best first, with odds by whole views."""
    ranked = suppress_near(sort_by_score(hypotheses), MOST_LISTED, MIN_DISTANCE, MIN_ANGLE)
    asked = replace(query, num_parts=0)
    best, *others = ranked
    covariance = estimate_covariance(query, best.pose)
    standings = assess_poses(asked, best, others)
    *probabilities, none = posterior(standings, covariance)
    return [
        State(h.pose, log_ratio(float(p), float(none)), h.score, covariance if h is best else None)
        for h, p in zip(ranked, probabilities, strict=True)
    ]


def associate(query: Query, states: Sequence[State], found: Hypothesis) -> State | None:
    """Make a state of another pose of a frame, with its odds relative to the best state.

    None if the frame has the pose already, or if it is too much worse to be a copy.
    """
    best = max(states, key=lambda state: state.log_odds)
    if any(is_same(state.pose, found.pose) for state in states):
        return None
    asked, at_best = replace(query, num_parts=0), Hypothesis(best.pose, best.score)
    first, second = posterior(assess_poses(asked, at_best, [found]), None)[:2]
    odds = best.log_odds + log_ratio(float(second), float(first))
    if odds < best.log_odds - OTHER_LOG_ODDS:
        return None
    return State(found.pose, odds, found.score, estimate_covariance(query, found.pose), best.num_matches)


def is_same(pose: Pose, other: Pose) -> bool:
    """Return True if two poses are nearer than distinct poses are."""
    distance, angle = pose_errors(pose, other)
    return distance < MIN_DISTANCE and angle < MIN_ANGLE
