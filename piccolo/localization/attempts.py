"""The searches that are tried for a photo, in order, each with its refinement.

A first look by whole views finds most upright photos of the whole sphere, without local features. Only
features show that a photo is mirrored, so the first look briefly searches its mirror image too.
If that fits clearly better, the photo was turned over, and is searched no further.
"""

import math
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np

from ..evidence.examine import check_prior, choose, examine
from ..evidence.verification import Verified, draw_near, verify
from ..judge.candidate import Candidate
from ..judge.selection import is_clear, is_sure, rank
from ..local_features.hypotheses import MatchedPose, propose_poses
from ..local_features.matching import Matches, match_located, merge_matches
from ..photo.photo import NOTHING_KNOWN
from ..problem.method import Method
from ..problem.photo_images import find_all_around
from ..problem.problem import Problem
from ..problem.profile import Beam, Tilts
from ..problem.settings import Effort
from ..scan_map.camera_positions import COARSE_SPACING
from ..scan_map.scan_map import ScanMap
from ..system.jobs.threads import Once, Workers
from .beam import refine_matches, refine_starts, score_mirror, score_near, score_starts
from .means import Means
from .search import search_poses

FIRST_BEAM = Beam(100, 12, 4, 1)
FIRST_ROTATIONS = 1000  # rotations of a brief search with any tilt
FEW_CELLS = 200  # cells of the grid: if a prior leaves fewer, all of them are searched
PLACES_AT_ONCE = 32  # places at which the scan is drawn before poses are proposed
COS_TILT = math.cos(math.radians(12.0))  # of the largest angle between a proposed pose's tilt and a known one


class Attempt(Protocol):
    """One search with its refinement."""

    def __call__(
        self, problem: Problem, known: list[Candidate], means: Means
    ) -> tuple[list[Candidate], bool]:
        """Return the known candidates with further ones; True if these make later attempts needless."""


def plan_attempts(problem: Problem) -> list[tuple[Problem, Attempt]]:
    """Return the searches for a photo in order, each with the problem whose evidence it uses.

    Brief looks come first: for a whole upright sphere by whole views, then with the scan drawn at the poses
    found; for a photo of edges along the walls. Searches by whole views follow, with gravity `auto` at the
    known tilt, then at any tilt (briefly, for a whole sphere). The search by matches with the scan drawn at
    the map's places is last, as these may have to be drawn; only for partial photos of any tilt it precedes
    the views. Partial photos are mostly taken about level: if the tilt is not known exactly, "known" searches
    about level, and begins with a brief search.
    """
    profile = problem.profile
    looks_first = profile.uses_matches and can_look_first(problem)
    first: list[tuple[Problem, Attempt]] = []
    if looks_first:
        by_views = problem.by_views()
        first = [(by_views, look_first), (by_views.mirror(), look_mirrored), (problem, draw_found)]
    if problem.rotations is not None:
        first.append((problem, look_along_walls))
    views: list[tuple[Problem, Attempt]] = []
    if profile.is_always_upright or problem.gravity != "unknown":
        upright: Tilts = "known" if problem.photo.has_tilt else profile.default_tilt
        if profile.is_narrow:
            views.append((problem, partial(search_briefly, tilts=upright)))
        views.append((problem, partial(search_views, tilts=upright)))
    if problem.gravity != "known":
        views.append((problem, partial(search_views, tilts="any", is_brief=looks_first)))
    features: list[tuple[Problem, Attempt]] = [(problem, search_features)] if profile.uses_matches else []
    features_last = looks_first or (profile.is_narrow and problem.gravity != "unknown")
    return [*first, *views, *features] if features_last else [*first, *features, *views]


def look_first(problem: Problem, known: list[Candidate], means: Means) -> tuple[list[Candidate], bool]:
    """Search briefly by whole views; True if one pose alone explains the photo, better than if mirrored."""
    effort, workers, watch, _ = means
    of_mirror = Once(score_mirror, problem, effort, workers)
    with workers.beside(of_mirror):
        with watch.stage("search"):
            starts = search_poses(problem, "known", effort.brief(), workers)
        with watch.stage("refine"):
            found = known + refine_starts(problem, starts, FIRST_BEAM, workers)
            if not is_clear(problem.profile, choose(problem, rank(found), workers)):
                return found, False
            own = score_starts(problem, starts, workers)
            return found, beats_mirror(problem.method, own, of_mirror())


def beats_mirror(method: Method, own: float, mirrored: float) -> bool:
    """Return True if by brief scores a photo fits better as it is than mirrored."""
    return own >= method.first_mirror_ratio * mirrored


def look_mirrored(problem: Problem, known: list[Candidate], means: Means) -> tuple[list[Candidate], bool]:
    """Search a mirrored photo briefly by whole views; True if it was turned over.

    Then one pose alone explains the mirrored photo, and more than any pose of the photo as it is. It is
    refined only if a brief score is better too.
    """
    effort, workers, watch, _ = means
    own = rank(known).best
    with watch.stage("search"):
        starts = search_poses(problem, "known", effort.brief(), workers)
    with watch.stage("refine"):
        brief = score_near(problem.mirror(), own.pose, workers)
        if not beats_mirror(problem.method, score_starts(problem, starts, workers), brief):
            return known, False
        chosen = choose(problem, rank(refine_starts(problem, starts, FIRST_BEAM, workers)), workers)
        explains_more = was_turned_over(problem.method, own.score, chosen.best.score)
        return known, explains_more and is_clear(problem.profile, chosen)


def was_turned_over(method: Method, own: float, mirrored: float) -> bool:
    """Return True if by its scores a photo fits much better mirrored than as it is."""
    return mirrored >= max(method.turned_over_score, method.turned_over_ratio * own)


def draw_found(problem: Problem, known: list[Candidate], means: Means) -> tuple[list[Candidate], bool]:
    """Draw the scan at the best of the known candidates; True if the best of all is sure."""
    with means.watch.stage("refine"):
        return end_search(problem, known, means.workers)


def look_along_walls(problem: Problem, known: list[Candidate], means: Means) -> tuple[list[Candidate], bool]:
    """Search the few rotations that put a photo's lines along walls; True if one pose alone explains it."""
    refined = search_and_refine(problem, "known", FIRST_BEAM, means)
    with means.watch.stage("refine"):
        found = known + refined
        return found, is_clear(problem.profile, choose(problem, rank(found), means.workers))


def search_features(problem: Problem, known: list[Candidate], means: Means) -> tuple[list[Candidate], bool]:
    """Match a photo with the scan drawn at its places, some at a time; True if the result is sure.

    The places nearest to known candidates come first, and are enough if a pose has matches: of panoramas of
    which 60 % was hidden, right ones had 11 and more, wrong ones up to 9. Poses by other places are dropped
    unless one is sure: all together give better ones.
    """
    workers = means.workers
    places = problem.scan_map.places
    matched: list[Matches] = []
    found = kept = known
    with means.watch.stage("match"):
        keypoints = find_all_around(problem.photo, workers)
    likely = np.array([one.pose.center_world for one in known]).reshape(-1, 3)
    allowed = problem.scan_map.centers[problem.scan_map.sparse]
    chosen = places.choose(allowed, likely, problem.profile.most_places)
    for begin in range(0, len(chosen), PLACES_AT_ONCE):
        end = begin + PLACES_AT_ONCE
        is_likely = begin == 0 and len(known) > 0
        with means.watch.stage("match"):
            pictures = places.draw(chosen[begin:end].tolist(), workers)
            matched += workers.map(partial(match_located, keypoints), pictures, "match")
            poses = propose_level(problem, merge_matches(matched), workers)
            most = poses[0].num_matches if poses else 0
            is_tried = is_likely or end >= len(chosen) or most >= problem.method.enough_matches
            if not is_tried:
                continue
            refined = refine_matches(problem, [one.pose for one in poses], workers)
            found, is_enough = end_search(problem, kept + add_verified(problem, refined, workers), workers)
        if is_enough or (is_likely and most >= problem.method.sure_matches):
            return found, is_enough
        kept = found if is_likely else kept
    return found, False


def propose_level(problem: Problem, matches: Matches, workers: Workers) -> list[MatchedPose]:
    """Return poses from feature matches, best first; level ones only if the tilt is known."""
    has_exact_tilt = problem.photo.has_tilt or problem.profile.default_tilt == "known"
    is_level = problem.gravity == "known" and has_exact_tilt
    up_cam = problem.photo.R_cam_from_level[:, 2]
    found = propose_poses(matches, problem.method.most_matched, workers)
    return [f for f in found if not is_level or f.pose.R_cam_from_world[:, 2] @ up_cam >= COS_TILT]


def search_briefly(
    problem: Problem, known: list[Candidate], means: Means, tilts: Tilts
) -> tuple[list[Candidate], bool]:
    """Search by whole views and refine the few best starts; True if the result is sure."""
    brief = means._replace(effort=means.effort.brief())
    return add_found(problem, search_and_refine(problem, tilts, FIRST_BEAM, brief), known, means)


def search_views(
    problem: Problem, known: list[Candidate], means: Means, tilts: Tilts, is_brief: bool = False
) -> tuple[list[Candidate], bool]:
    """Search by whole views and refine; True if the result is sure."""
    if is_brief:
        thin = means._replace(effort=thin_effort(means.effort))
        refined = search_and_refine(thin_out(problem), tilts, FIRST_BEAM, thin)
    else:
        refined = search_and_refine(problem, tilts, problem.profile.beam, means)
    return add_found(problem, refined, known, means)


def add_found(
    problem: Problem, refined: list[Candidate], known: list[Candidate], means: Means
) -> tuple[list[Candidate], bool]:
    """Add poses from whole views, refined and verified; True if the best is sure."""
    with means.watch.stage("refine"):
        found = known + add_verified(problem, refined, means.workers)
        return end_search(problem, found, means.workers)


def end_search(problem: Problem, found: list[Candidate], workers: Workers) -> tuple[list[Candidate], bool]:
    """Draw the scan at the best candidates; return all with their evidence, and True if the best is sure."""
    ranked = rank(found)
    if ranked.best.score < problem.method.faint_score:
        return found, False
    chosen = choose(problem, ranked, workers)
    drawn = {id(candidate.pose): candidate for candidate in chosen.candidates}
    return [drawn.get(id(one.pose), one) for one in found], is_sure(problem.profile, chosen)


def search_and_refine(problem: Problem, tilts: Tilts, beam: Beam, means: Means) -> list[Candidate]:
    """Search by whole views, and refine the starts to a few poses."""
    with means.watch.stage("search"):
        starts = search_poses(problem, tilts, means.effort, means.workers)
    with means.watch.stage("refine"):
        return refine_starts(problem, starts, beam, means.workers)


def add_verified(problem: Problem, candidates: list[Candidate], workers: Workers) -> list[Candidate]:
    """Verify candidates by matches, if the profile wants it; add poses refined on many matches."""
    if not problem.profile.refines_on_matches or not candidates:
        return candidates

    def verify_one(candidate: Candidate) -> tuple[Candidate, Verified]:
        drawn = draw_near(problem, candidate.pose, candidate.drawn, workers)
        return replace(candidate, drawn=drawn), verify(problem, candidate.pose, drawn.matches)

    verified = workers.map(verify_one, rank(candidates).candidates, "verify")
    drawn = {id(candidate.pose): candidate for candidate, _ in verified}
    chance = problem.method.chance_matches
    matched = [(near, found.pose) for near, found in verified if found.num_matches > chance]
    refined = workers.map(lambda pair: examine(problem, pair[1], pair[0]), matched, "compare")
    return [*(drawn.get(id(one.pose), one) for one in candidates), *refined]


def search_beyond_prior(problem: Problem, scan_map: ScanMap, means: Means) -> list[Candidate]:
    """Search a whole photo without its prior: poses that the prior allows must beat those it excludes."""
    is_needed = not problem.prior.is_empty and can_look_first(problem)
    if not is_needed:
        return []
    anywhere = replace(problem, scan_map=scan_map, prior=NOTHING_KNOWN)
    brief = means._replace(effort=means.effort.brief())
    found = search_and_refine(anywhere, "known", FIRST_BEAM, brief)
    return [check_prior(problem, candidate) for candidate in found]


def can_look_first(problem: Problem) -> bool:
    """Return True if the photo shows nearly the whole sphere, and its tilt may be the known one."""
    return problem.gravity != "unknown" and problem.profile.looks_first


def thin_out(problem: Problem) -> Problem:
    """Return the problem with every other cell of the grid, for a whole photo that was searched as upright.

    With few rotations (`thin_effort`), this finds tilted photos without occluders; the search by local
    features finds the others.
    """
    m = problem.scan_map
    cells = np.floor(m.centers[m.sparse] / COARSE_SPACING).astype(np.int64)
    is_even = (cells.sum(axis=1) % 2 == 0) | (len(cells) < FEW_CELLS)
    return replace(problem, scan_map=m.narrow(is_even))


def thin_effort(effort: Effort) -> Effort:
    """Return the effort of a brief search with any tilt."""
    return effort.brief()._replace(num_rotations=min(FIRST_ROTATIONS, effort.num_rotations))
