"""The default method, one line a step: localize one panorama in a prepared map."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from ..evidence.examine import examine_each
from ..geometry.nearness import CONFIRMED
from ..geometry.pose import Pose
from ..judge.alternatives import MAX_ALTERNATIVES
from ..judge.belief import NOTHING, make_belief
from ..judge.by_others import share_place
from ..judge.candidate import NO_CHOICE, Candidate, Selection
from ..judge.probability import LOCALIZED
from ..judge.reasons import Reason
from ..judge.result import Result, nothing_found
from ..judge.result_parts import WIDE, Alternative, FocalLength
from ..judge.selection import is_faint, rank
from ..photo.panorama import Panorama
from ..photo.panorama.edges import find_axes
from ..photo.photo import Prior
from ..problem.prior import apply_prior, nothing_allowed
from ..problem.problem import Problem, prepare_problem
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from ..system.jobs.threads import Stopwatch, one_blas_thread
from .attempts import Attempt, add_verified, plan_attempts, search_beyond_prior
from .claimed_geometry import calibrate, calibrate_sphere
from .judging import Found, judge
from .last_descent import refine_best
from .means import Means, Step, describe_candidates, describe_selection
from .shape import align_level, find_tilts, is_explained_by_edges, is_tilt_known

# changes of a guessed focal length's logarithm: one comes near enough to a true one that differs by 20 %
GUESSES = (0.0, -0.15, 0.15)
MOST_RANGE = 10.0  # [m] of surfaces: times the change of the focal length's log, it is how far a pose moves
NO_PIXEL = "the panorama: no pixel counts, all are masked"


@one_blas_thread()
def localize(scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, means: Means) -> Result:
    """Localize a panorama: search until one attempt is sure, refine the best poses, judge the best one."""
    problem = prepare_search(scan_map, panorama, settings, means.watch)
    if problem is None:
        return explain_nothing(scan_map, panorama, settings.prior)
    with means.watch.stage("search"):
        problem.photo.images.search()  # each search begins with it
    search = find_by_edges if problem.profile.follows_walls else find
    found = search(problem, scan_map, means)
    with means.watch.stage("refine"):
        return judge(found, means, settings.demand)


def prepare_search(
    scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, watch: Stopwatch
) -> Problem | None:
    """Prepare a panorama for the search where the prior allows; None if there is nothing to search."""
    with watch.stage("search"):
        allowed_map = apply_prior(scan_map, settings.prior)
        if len(allowed_map.sparse) == 0 or not panorama.is_valid.any():
            return None
        return prepare_problem(panorama, allowed_map, settings.prior, settings.gravity, settings.method)


def explain_nothing(scan_map: ScanMap, panorama: Panorama, prior: Prior) -> Result:
    """Return the result of a photo that can be searched nowhere, with the reason."""
    if len(apply_prior(scan_map, prior).sparse) > 0:
        return nothing_found(NO_PIXEL)
    has_positions = len(scan_map.centers) > 0  # then the prior excludes all of them
    belief = NOTHING.rule_out(Reason.NOWHERE) if has_positions else NOTHING
    return nothing_found(nothing_allowed(scan_map, prior), belief=belief)


def find(problem: Problem, scan_map: ScanMap, means: Means) -> Found:
    """Search until one attempt is sure, and refine the best poses to the end.

    `scan_map` is the whole map; the problem has the part of it that the prior allows. If the photo was turned
    over, the result has its mirrored images, and no pose.
    """
    images = problem.photo.images
    workers = means.workers
    # idle cores prepare the images that later steps need
    with workers.beside(images.middle, images.fine, images.full, problem.colors):
        searched, candidates = make_attempts(plan_attempts(problem), means)
        if searched.is_mirrored:
            return Found(searched, NO_CHOICE, None)
        candidates += search_beyond_prior(searched, scan_map, means)
        with means.watch.stage("refine"):
            refined = refine_best(searched, candidates, workers)
            means.trace.note("refined", partial(describe_selection, searched, refined))
            return fit_camera(searched, refined, means)


def make_attempts(
    planned: Sequence[tuple[Problem, Attempt]], means: Means
) -> tuple[Problem, list[Candidate]]:
    """Make attempts until one finds a sure pose; return the last one's problem, and all candidates."""
    candidates: list[Candidate] = []
    for problem, attempt in planned:
        candidates, is_enough = attempt(problem, candidates, means)
        means.trace.note("attempt", partial(describe_attempt, problem, attempt, candidates, is_enough))
        if is_enough:
            break
    return problem, candidates


def describe_attempt(
    problem: Problem, attempt: Attempt, candidates: Sequence[Candidate], is_enough: bool
) -> Step:
    """Describe an attempt, and all candidates that are known after it."""
    how = attempt.keywords if isinstance(attempt, partial) else {}
    function = attempt.func if isinstance(attempt, partial) else attempt
    return {
        "name": getattr(function, "__name__", ""),
        "options": how,
        "evidence": problem.profile.evidence,
        "num_positions": len(problem.scan_map.sparse),
        "is_enough": is_enough,
        "candidates": describe_candidates(problem, rank(candidates).candidates if candidates else []),
    }


def find_by_edges(problem: Problem, scan_map: ScanMap, means: Means) -> Found:
    """Find the poses of a photo in a scan without colours, at one tilt of the camera after another."""
    axes = find_axes(problem.source)
    yaw_of_walls = scan_map.yaw_of_walls
    level = align_level(problem, axes, yaw_of_walls)
    found = [find(level, scan_map, means)]  # most cameras are about level
    if not is_tilt_known(problem) and not is_explained_by_edges(found[0].selection, level):
        with means.watch.stage("search"):
            tilts = find_tilts(problem, axes, yaw_of_walls, means.effort, means.workers)
        found += [find(tilt, scan_map, means) for tilt in tilts]
    best = max(found, key=lambda one: one.selection.best.score)
    if level.rotations is None or is_explained_by_edges(best.selection, level):
        return best
    in_any_heading = find(replace(level, rotations=None), scan_map, means)
    return max([best, in_any_heading], key=lambda one: one.selection.best.score)


def refine_known(problem: Problem, poses: Sequence[Pose], means: Means) -> Found:
    """Refine poses in the map to the end that are known without a search."""
    workers = means.workers
    candidates = add_verified(problem, examine_each(problem, poses, workers), workers)
    return fit_camera(problem, refine_best(problem, candidates, workers), means)


def fit_camera(problem: Problem, found: Selection, means: Means) -> Found:
    """Compare the geometry that a photo claims with the scan, and refine the poses by the geometry found.

    Nothing is compared if the poses are faint, for photos of several cameras, and for panoramas in scans
    without colours, as a photo's edges do not lie exactly on those of the scan.
    """
    if is_faint(problem.profile, found):
        return Found(problem, found, None)
    if problem.given.focal_prior is not None:
        return Found(*calibrate(problem, found, means.workers))
    if problem.given.cameras or not problem.profile.fits_sphere:
        return Found(problem, found, None)
    return Found(*calibrate_sphere(problem, found, means.workers))


def has_guessed_focal(panorama: Panorama) -> bool:
    """Return True if the focal length is a guess, so that `localize_guessed` should try several."""
    return panorama.focal_prior is not None and panorama.focal_prior.deviation > WIDE


def list_guessed(panorama: Panorama) -> list[Panorama]:
    """Return a photo with each of several focal lengths around its own, if that is a guess; else as it is."""
    if not has_guessed_focal(panorama):
        return [panorama]
    camera = panorama.cameras[0].camera
    width = panorama.rgb.shape[1]
    return [panorama.resample(camera.change(guess), width) for guess in GUESSES]


def localize_guessed(
    scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, means: Means
) -> Result:
    """Localize a photo with several focal lengths around a guess, until one result is sure."""
    found: list[Result] = []
    for photo in list_guessed(panorama):
        found.append(localize(scan_map, photo, settings, means))
        if found[-1].status == LOCALIZED:
            break
    return select_likeliest(found, settings)


def is_same_but_for_focal(one: Result, pose: Pose, focal: FocalLength | None) -> bool:
    """Return True if a pose is that of a result, but for a move along the direction of view.

    The difference of the focal lengths with which they were found must explain the move.
    """
    own = one.best_pose
    if own is None:
        return False
    change = math.log(focal.px / one.focal_length.px) if focal and one.focal_length else 0.0
    offset = pose.center_world - own.center_world
    ahead = own.R_cam_from_world[0]
    along = float(offset @ ahead)
    moved = Pose(pose.R_cam_from_world, pose.center_world - along * ahead)
    return abs(along) < CONFIRMED.distance + MOST_RANGE * abs(change) and CONFIRMED.holds(own, moved)


def select_likeliest(found: Sequence[Result], settings: CoarseToFineSettings) -> Result:
    """Return the most confident of several results, its confidence reduced by results at other places."""
    places: list[Result] = []
    for one in sorted(found, key=lambda f: -f.confidence):
        pose = one.best_pose
        if not any(pose is None or is_same_but_for_focal(f, pose, one.focal_length) for f in places):
            places.append(one)
    best, *elsewhere = places
    others = [
        (Alternative(f.best_pose, f.evidence.score, f.evidence.num_matches), f.confidence)
        for f in elsewhere
        if f.best_pose and f.evidence
    ]
    if not any(confidence for _, confidence in others):
        return best
    factor, shared = share_place(best.belief, [best.confidence, *(confidence for _, confidence in others)])
    own = [
        (alternative, factor * place)
        for alternative, place in zip(best.alternatives, best.belief.place[1:-1], strict=True)
        if not any(CONFIRMED.holds(other.pose, alternative.pose) for other, _ in others)
    ]
    listed = [*zip([other for other, _ in others], shared, strict=True), *own][:MAX_ALTERNATIVES]
    alternatives = tuple(alternative for alternative, _ in listed)
    belief = make_belief([factor * best.belief.place[0], *(p for _, p in listed)])
    belief = replace(best.belief, place=belief.place)
    return replace(best, alternatives=alternatives).take_belief(belief, settings.min_confidence)
