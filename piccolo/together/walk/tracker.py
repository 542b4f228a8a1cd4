"""Tracking of a camera through a scan, frame by frame, from past frames only."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from ...evidence.examine import complete, examine
from ...evidence.verification import draw_near, match_beside, place_keypoints, verify
from ...geometry.nearness import ONE_ANSWER, ONE_PLACE, non_maximum_suppression
from ...geometry.pose import Pose, uniform_yaws
from ...jobs.threads import Stopwatch, Workers, one_blas_thread
from ...judge.candidate import Selection
from ...judge.probability import MODELS, Standing, pose_features, posterior
from ...judge.selection import assess
from ...judge.sure import SURE_ODDS
from ...localization.attempts import can_look_first
from ...localization.beam import Ends, descend_briefly, score_briefly, score_mirror, score_near
from ...localization.localize import localize
from ...localization.means import Means
from ...localization.near import Near, refine_near
from ...panorama import Panorama
from ...problem.prior import apply_prior
from ...problem.problem import Problem, prepare_problem
from ...problem.settings import CoarseToFineSettings, Effort
from ...scan_map.camera_positions import FreeSpace
from ...scan_map.scan_map import ScanMap
from .expectation import (
    Expected,
    Followed,
    Place,
    describe_end,
    expect,
    is_acceptable,
    list_alike,
    list_starts,
)
from .frames import (
    MOST_EXPECTED,
    MOST_ODDS,
    REACH_SLACK,
    Frame,
    Motion,
    State,
    list_states,
    log_ratio,
    put_state,
)
from .path import COPY_LOG_ODDS, EVEN, Lattice

Read = Callable[[int], Panorama | None]  # the picture of a frame; None if it can't be read
LEAST_SCORE = 0.05  # of a tracked pose: with less it explains nothing
NUM_KEPT = 4  # problems, of the frames that were asked for last
BETWEEN_KEYS = ONE_PLACE.distance  # [m] key frames are so far apart
MOST_PLACES = 64  # of a frame: the rooms of a hotel that look alike
ELSEWHERE = ONE_PLACE.distance + 2.0 * REACH_SLACK  # [m] reach beyond which a camera may be at another place


class Tracker:
    """The forward half of a walk: `add` uses past frames only, and keeps their poses."""

    def __init__(
        self, scan_map: ScanMap, settings: CoarseToFineSettings, workers: Workers, motion: Motion
    ) -> None:
        self.scan_map: ScanMap = apply_prior(scan_map, settings.prior)
        self.settings = settings
        self.workers = workers
        self.motion: Motion = motion
        self.lattice: Lattice = Lattice(FreeSpace(scan_map.octree, scan_map.centers, workers), motion)
        self.read: Read = lambda k: None  # until somebody keeps the pictures
        self.means = Means(settings.effort, workers, Stopwatch())
        self.problems: dict[int, Problem] = {}  # by the number of the frame
        self.found_at: float = -math.inf  # time when it was last found; before that, of the first search
        self.next_search: float = 0.0  # [m] reach since then at which all places are searched again

    @property
    def frames(self) -> list[Frame]:
        """Frames so far."""
        return self.lattice.frames

    def forget_times(self) -> None:
        """Use the numbers of frames as times, from the first frame on: only their order is known."""
        self.motion = self.lattice.motion = replace(self.motion, is_timed=False)

    def prepare(self, panorama: Panorama) -> Problem:
        """Prepare the problem of a frame, with the images that its descents need."""
        settings = self.settings
        problem = prepare_problem(panorama, self.scan_map, settings.prior, settings.gravity, settings.method)
        for image in problem.photo.images:
            image()
        return problem

    @one_blas_thread()
    def add(self, panorama: Panorama, problem: Problem, time: float, odometry: Pose | None = None) -> Frame:
        """Localize the next frame, whose problem is prepared; the first waits until free space is known."""
        frame = Frame(time, odometry=odometry)
        if panorama.is_valid.any() and len(self.scan_map.centers) > 0:
            self._keep(len(self.frames), problem)
            self.lattice.space.prepare()
            is_known = odometry is not None or not self.frames
            is_far = not is_known and self.motion.reach(time - self.frames[-1].time) > ELSEWHERE
            if not is_far:
                self._follow(problem, frame)
            if is_far or (not frame.states and self.motion.reach(time - self.found_at) >= self.next_search):
                self._search(problem, panorama, frame)
            elif frame.states and self._is_telling(frame):
                frame.states = list_key_states(problem, frame.states, self.means)
                frame.is_key = True
        self.lattice.add(frame)
        if frame.is_key:
            self._depart(problem, frame)
        self._note(frame)
        return frame

    def accept(self, frame: Frame) -> None:
        """Add a frame that was localized earlier."""
        self.lattice.add(frame)
        self._note(frame)

    def _note(self, frame: Frame) -> None:
        """Note when the camera was found, or when it is to be searched everywhere again."""
        is_found = frame.arrived is not None or frame.departed is not None
        if is_found or (frame.alone is not None and math.isinf(self.found_at)):
            self.found_at = frame.time
            self.next_search = ELSEWHERE
        elif frame.alone is not None:
            self.next_search = 2.0 * self.motion.reach(frame.time - self.found_at)

    def _is_telling(self, frame: Frame) -> bool:
        """Return True if the camera has moved so far since the last key frame that it sees another place."""
        begin = None if frame.key is None else self.frames[frame.key].tracking_pose
        return begin is None or frame.arrived is None or frame.arrived.distance(begin) >= BETWEEN_KEYS

    def _follow(self, problem: Problem, frame: Frame) -> None:
        """Find a frame from the last one that was found."""
        key = self._last_key()
        if key is None:
            return
        since = [key, *(k for k in range(key + 1, len(self.frames)) if self.frames[k].key == key)]
        near = [(k, pose) for k in since[:-3:-1] if (pose := self.frames[k].tracking_pose)]
        found = self.find(problem, frame, near)
        if found is None:
            return
        frame.states = [found.state]
        frame.how = found.how
        if found.how == "tracked":
            frame.arrived = found.state.pose
            frame.key = key

    def find(self, problem: Problem, frame: Frame, near: Sequence[tuple[int, Pose]]) -> Followed | None:
        """Find a frame from others, the last of them first, by their numbers and poses.

        A narrow photo is matched with those of them that are sure by themselves.
        """
        if problem.profile.is_narrow:
            sure = [(k, pose) for k, pose in near if self.frames[k].log_odds >= SURE_ODDS]
            others = [(other, pose) for k, pose in sure if (other := self.problem_of(k))]
            located = (place_keypoints(*other, self.workers) for other in others)
            beside = tuple(match_beside(problem, one, self.workers) for one in located)
            problem = replace(problem, beside=beside)
        expected = expect(frame, [(self.frames[k], pose) for k, pose in near], self.motion)
        return find_near(problem, expected, self.means)

    def problem_of(self, k: int) -> Problem | None:
        """Return a frame's problem; None if its picture can't be read or shows nothing."""
        problem = self.problems.pop(k, None)
        if problem is None:
            panorama = self.read(k)
            if panorama is None or not panorama.is_valid.any():
                return None
            problem = self.prepare(panorama)
        self._keep(k, problem)
        return problem

    def _keep(self, k: int, problem: Problem) -> None:
        """Keep the problem of a narrow photo among the last few."""
        if problem.profile.is_narrow:
            self.problems[k] = problem
        for old in list(self.problems)[:-NUM_KEPT]:
            del self.problems[old]

    def _last_key(self) -> int | None:
        """Return the number of the last key frame that can be tracked from."""
        numbers = (column.number for column in reversed(self.lattice.columns))
        return next((k for k in numbers if self.frames[k].departed is not None), None)

    def _search(self, problem: Problem, panorama: Panorama, frame: Frame) -> None:
        """Search the whole scan for a frame, which is then a key frame."""
        frame.alone = localize(self.scan_map, panorama, self.settings, self.means)
        is_sure = frame.is_localized_alone
        is_mirrored = not is_sure and can_look_first(problem) and fits_mirror(problem, self.means)
        if found := [] if is_mirrored else list_states(self.scan_map, frame.alone):
            frame.how = "alone"
            frame.states = list_key_states(problem, found[:1] if is_sure else found, self.means, is_sure)
            frame.is_key = True

    def _depart(self, problem: Problem, frame: Frame) -> None:
        """Refine the likeliest place of a key frame: if it is likely, the next frames are tracked from it.

        Of places about as likely, as copies are, it is the one that looks best.
        """
        while True:
            probabilities = self.lattice.filter_path().probabilities[-1]
            is_likely = probabilities >= EVEN * probabilities.max()
            likeliest = max(compress(frame.states, is_likely), key=lambda state: state.log_odds)
            if likeliest.is_refined:
                break
            frame.states = refine_state(problem, frame.states, likeliest, self.workers)
            self.lattice.change_last()
        frame.departed = likeliest.pose if probabilities.sum() > EVEN else None
        if likeliest is not frame.states[0]:
            frame.states = put_state(frame.states, likeliest)
            self.lattice.change_last()


def fits_mirror(problem: Problem, means: Means) -> bool:
    """Return True if the mirrored photo has the better pose by brief searches."""
    effort = means.effort.brief()
    own = score_briefly(problem, effort, means.workers)
    return score_mirror(problem, effort, means.workers) > own


def list_key_states(
    problem: Problem, own: Sequence[State], means: Means, is_sure: bool = False
) -> list[State]:
    """List the states of a key frame: the poses that were found for it, best first, and all other places.

    If the photo is sure by itself, other places get the lowest odds that one frame may give.
    """
    best = own[0]
    limit = -MOST_ODDS - COPY_LOG_ODDS if is_sure else 0.0
    rough = [
        State(pose, best.log_odds + min(behind, limit))
        for pose, behind in find_places(problem, best.pose, means)
        if not any(ONE_PLACE.holds(pose, state.pose) for state in own)
    ]
    states: list[State] = []
    for state in (*own, *rough):
        if not any(ONE_ANSWER.holds(state.pose, other.pose) for other in states):
            states.append(state)
    return states[:MOST_PLACES]


def refine_state(problem: Problem, states: Sequence[State], rough: State, workers: Workers) -> list[State]:
    """Refine a rough state; its odds are then relative to those of the best refined one, by whole views.

    It is dropped if a frame would not be tracked there, or has that pose already.
    """
    best = max((s for s in states if s.is_refined), key=lambda s: s.log_odds)
    end = track(problem, rough.pose, workers)
    others = [s for s in states if s is not rough]
    if end is None or any(s.is_refined and ONE_ANSWER.holds(s.pose, end.pose) for s in others):
        return others
    by_views = problem.by_views()
    ends = [s.end or replace(examine(by_views, s.pose), score=s.score or 0.0) for s in (best, end)]
    standings = assess(by_views.profile, complete(by_views, Selection(ends[0], (ends[1],)), workers))
    first, second = posterior(standings, None)[:2]
    return put_state(others, replace(end, log_odds=best.log_odds + log_ratio(float(second), float(first))))


def find_near(problem: Problem, expected: Expected, means: Means) -> Followed | None:
    """Track a frame from the expected pose, if that looks hardly worse than the best place within reach.

    Else, or if that fails, it is tracked from that place. An end away from the expected pose counts only if
    the photo is sure of it by itself; and so does an end at an expected pose that looks worse, which is tried
    last with a narrow photo, of which views tell little. None if none holds, or if the mirrored photo fits
    better.
    """
    near, effort = narrow_down(problem, expected.last, expected.reach, means.effort)
    workers = means.workers
    ends = descend_briefly(near, effort, workers)
    if not problem.profile.is_partial and score_mirror(near, effort, workers) > ends.best_score:
        return None
    score = score_near(problem, expected.pose, workers)
    best_score = max(ends.best_score, score)
    behind = log_behind(problem, score, best_score)
    alike = list_alike(expected, list_places(problem, ends, best_score))
    for start in list_starts(expected, behind, alike, problem.profile.is_narrow):
        end = track(problem, start.pose, workers)
        if end is not None and is_acceptable(end, expected, start.must_be_sure):
            return describe_end(replace(end, gain=compute_gain(problem, near)), expected, alike)
    return None


def compute_gain(problem: Problem, near: Problem) -> float:
    """Return what a frame gains [log] if it is found among some places: the fewer, the less it is by chance.

    A narrow photo gains nothing: it may look the same at two poses near each other.
    """
    share = len(near.scan_map.sparse) / len(problem.scan_map.sparse)
    return 0.0 if problem.profile.is_partial else min(-math.log(share), MOST_EXPECTED)


def track(problem: Problem, start: Pose, workers: Workers) -> State | None:
    """Refine a pose; None if the end more likely is wrong than right, or explains nothing.

    A narrow photo is tracked again from where its matches put it.
    """
    ends = [refine_near(problem, start, workers)]
    if problem.profile.is_narrow:
        first = ends[0].end
        drawn = draw_near(problem, first.pose, first.drawn, workers).matches
        ends.append(refine_near(problem, verify(problem, first.pose, drawn).pose, workers))
    return choose_end(ends)


def choose_end(ends: Sequence[Near]) -> State | None:
    """Return the likeliest end; None if it more likely is wrong than right, or explains nothing."""
    odds = [log_ratio(near.place, 1.0 - near.place) for near in ends]
    best = int(np.argmax(odds))
    end, gaussian, _ = ends[best]
    is_wrong = odds[best] < 0.0 or end.score < LEAST_SCORE
    return None if is_wrong else State(end.pose, odds[best], end.score, gaussian, end.forget())


def narrow_down(problem: Problem, pose: Pose, radius: float, effort: Effort) -> tuple[Problem, Effort]:
    """Return the problem of whole views within a radius [m] of a pose, in its tilt and any heading.

    Return also the effort of its brief search.
    """
    m = problem.scan_map
    distances = np.linalg.norm(m.centers[m.sparse] - pose.center_world, axis=1)
    near = m if math.isinf(radius) else m.narrow(distances <= max(radius, float(distances.min())))
    level = pose.R_cam_from_world @ uniform_yaws(effort.num_yaws)
    close = replace(problem.by_views(), scan_map=near, rotations=level)
    return close, effort.brief(max(len(near.sparse), 1))


def find_places(problem: Problem, own: Pose, means: Means) -> list[Place]:
    """Find the distinct poses, of the tilt of its own, that look like a photo beside that; best first."""
    close, effort = narrow_down(problem, own, math.inf, means.effort)
    ends = descend_briefly(close, effort, means.workers)
    return list_places(problem, ends, score_near(problem, own, means.workers))


def list_places(problem: Problem, ends: Ends, own_score: float) -> list[Place]:
    """List the distinct ends with their odds to a pose of a score."""
    R, centers = ends.poses.R_cam_from_map, ends.poses.center_map
    kept = non_maximum_suppression(R, centers, MOST_PLACES, ONE_ANSWER)
    found = zip(ends.poses.take(kept).poses(), ends.scores[kept], strict=True)
    return [(pose, log_behind(problem, float(score), own_score)) for pose, score in found]


def log_behind(problem: Problem, score: float, own_score: float) -> float:
    """Return the log odds of a pose against another by their scores, at most 0, by the model of views."""
    standing = Standing(score / max(own_score, 1e-9), 1.0, None, problem.profile.by_views().evidence)
    weight = MODELS[standing.evidence].weights[0]
    return min(weight * float(pose_features(standing)[0]), 0.0)
