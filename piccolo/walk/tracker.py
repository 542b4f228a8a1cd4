"""Tracking of a camera through a scan, frame by frame, from past frames only."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import posterior
from ..geometry.pose import Pose, exp_so3, log_so3
from ..geometry.rotations import uniform_yaws
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..localization.attempts import brief_query
from ..localization.comparison import score_pose
from ..localization.covariance import estimate_covariance
from ..localization.last_descent import FULL_LIMITS, HOPELESS_SCORE, NEARLY
from ..localization.localize import localize
from ..localization.prior import apply_prior
from ..localization.query import Cache, Query, prepare_query
from ..localization.refinement import (
    descend,
    descend_fine,
    descend_middle,
    perturb_middle,
    refine,
)
from ..localization.search import search_poses
from ..localization.selection import assess_poses, rank
from ..localization.settings import Beam, CoarseToFineSettings
from ..panorama import Panorama
from ..scan_map.prior import Prior
from ..scan_map.scan_map import ScanMap
from .beliefs import EVEN
from .frames import (
    MOST_ODDS,
    SAME_PLACE,
    Frame,
    How,
    State,
    is_same,
    is_same_place,
    list_states,
    log_odds_of_place,
    log_ratio,
    put_state,
)
from .free_space import FreeSpace
from .motion import MAX_STEP, NO_ACCELERATION, Motion, carry
from .path import COPY_LOG_ODDS, MOST_EXPECTED, REACH_SLACK, Lattice
from .places import MOST_PLACES, find_places, is_mirror_image, is_mirrored, log_behind

SURE_ODDS = 4.0  # [log] 98 %: of 580 wrong ends of descents near the pose two had more than 2.4, 3.1 at most
NEAR_BEAM = Beam(25, 6, 3, 1)  # of a search near, whose best pose is tracked
MAX_RADIUS = 12.0  # [m] around its last pose in which a lost camera is looked for
FIRST_SEARCH = 3  # frames after which a lost camera is searched everywhere
LAST_SEARCH = 48  # and again, at the latest
MOST_REFINED = 4  # places of a key frame, until one is as good as it looks


class Follower(NamedTuple):
    """A pose from which the next frame is predicted."""

    pose: Pose
    time: float
    earlier: Pose | None = None  # a pose before it
    earlier_time: float = 0.0


class Found(NamedTuple):
    """The pose of a frame that was found from another's."""

    state: State
    how: How
    is_alone: bool = True  # False if other poses near look like it


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
    def add(self, panorama: Panorama, query: Query, time: float, odometry: Pose | None = None) -> Frame:
        """Localize the next frame, whose query is prepared."""
        frame = Frame(time, odometry=odometry)
        if panorama.is_valid.any() and len(self.scan_map.centers) > 0:
            is_known = odometry is not None or not self.frames
            is_far = (
                not is_known
                and self.motion.max_speed * (time - self.frames[-1].time) > SAME_PLACE + REACH_SLACK
            )
            if not is_far:
                self._follow(query, frame)
            if is_far or (not frame.states and self.num_lost + 1 >= self.next_search):
                self._search(query, panorama, frame)
            elif frame.states and self._is_telling(frame):
                frame.make_key(list_key_states(query, frame.states))
        self.lattice.add(frame)
        if frame.is_key:
            self._depart(query, frame)
        self._count(frame)
        return frame

    def accept(self, frame: Frame) -> None:
        """Add a frame that was localized earlier."""
        self.lattice.add(frame)
        self._count(frame)

    def _count(self, frame: Frame) -> None:
        """Count the frames for which the camera is lost."""
        if frame.arrived is not None or frame.departed is not None:
            self.num_lost = 0
            self.next_search = FIRST_SEARCH
            return
        self.num_lost += 1
        if frame.alone is not None:
            self.next_search = self.num_lost + min(max(self.num_lost, FIRST_SEARCH), LAST_SEARCH)

    def _is_telling(self, frame: Frame) -> bool:
        """Return True if the camera has moved so far since the last key frame that it sees another place.

        A frame that was found near it, at one of several places, tells too.
        """
        if frame.key is None or frame.arrived is None:
            return True
        move = frame.arrived.center_world - self._pose_since(frame.key).center_world
        return float(np.linalg.norm(move)) >= SAME_PLACE

    def _follow(self, query: Query, frame: Frame) -> None:
        """Descend from the pose predicted by the last ones; search near it if that fails."""
        follower = self._follower_to(frame)
        if follower is None:
            return
        found = find_from(query, follower, frame.time, self.motion)
        if found is None:
            return
        frame.states = [found.state]
        frame.how = found.how
        if found.is_alone:
            frame.arrived = found.state.pose
            frame.key = self._last_key()

    def _last_key(self) -> int | None:
        """Return the number of the last key frame that can be tracked from."""
        numbers = (column.number for column in reversed(self.lattice.columns))
        return next((k for k in numbers if self.frames[k].departed is not None), None)

    def _follower_to(self, frame: Frame) -> Follower | None:
        """Return the pose to track a frame from: that of the last frame that was found."""
        key = self._last_key()
        if key is None:
            return None
        since = [key, *(k for k in range(key + 1, len(self.frames)) if self.frames[k].key == key)]
        last = self.frames[since[-1]]
        pose = self._pose_since(since[-1])
        if frame.odometry is not None or len(since) == 1:
            return Follower(move_on(pose, last, frame), last.time)
        return Follower(pose, last.time, self._pose_since(since[-2]), self.frames[since[-2]].time)

    def _pose_since(self, k: int) -> Pose:
        frame = self.frames[k]
        pose = frame.departed if frame.is_key else frame.arrived
        if pose is None:
            raise ValueError("a frame that was not found")
        return pose

    def _search(self, query: Query, panorama: Panorama, frame: Frame) -> None:
        """Search the whole scan for a frame, which is then a key frame."""
        frame.alone = localize(self.scan_map, panorama, self.settings, self.workers, Stopwatch())
        is_sure = frame.is_localized_alone
        is_wrong = not is_sure and is_mirror_image(query)
        if found := [] if is_wrong else list_states(self.scan_map, frame.alone):
            frame.how = "alone"
            frame.make_key(list_key_states(query, found, is_sure))

    def _depart(self, query: Query, frame: Frame) -> None:
        """Refine the likeliest place of a key frame: if it is likely, the next frames are tracked from it."""
        for _ in range(MOST_REFINED):
            probabilities = self.lattice.filter_last()
            is_likely = probabilities >= EVEN * probabilities.max()
            odds = [state.log_odds for state in frame.states]
            likeliest = frame.states[int(np.where(is_likely, odds, -np.inf).argmax())]
            if likeliest.is_refined:
                frame.states = put_state(frame.states, likeliest)
                frame.departed = likeliest.pose if probabilities.sum() > EVEN else None
                break
            frame.states = refine_state(query, frame.states, likeliest)
            self.lattice.change_last()
        self.lattice.change_last()


def list_key_states(query: Query, refined: Sequence[State], is_sure: bool = False) -> list[State]:
    """List the states of a key frame: the poses that were refined for it, best first, and all other places.

    If the photo is sure by itself, the others have all of one frame's evidence against them.
    """
    best = refined[0]
    limit = -MOST_ODDS - COPY_LOG_ODDS if is_sure else 0.0
    rough = [
        State(p.pose, best.log_odds + min(p.behind, limit))
        for p in find_places(query, best.pose)
        if not any(is_same_place(p.pose, state.pose) for state in refined)
    ]
    states: list[State] = []
    for state in (*refined, *rough):
        if not any(is_same(state.pose, other.pose) for other in states):
            states.append(state)
    return states[:MOST_PLACES]


def refine_state(query: Query, states: Sequence[State], rough: State) -> list[State]:
    """Refine a rough state; its odds are then relative to those of the best refined one.

    It is dropped if a frame would not be tracked there, or has that pose already.
    """
    best = max((s for s in states if s.is_refined), key=lambda s: s.log_odds)
    end = track(query, rough.pose)
    others = [s for s in states if s is not rough]
    if end is None or any(s.is_refined and is_same(s.pose, end.pose) for s in others):
        return others
    ends = [Hypothesis(s.pose, s.score or 0.0) for s in (best, end)]
    first, second = posterior(assess_poses(replace(query, num_parts=0), ends[0], ends[1:]), None)[:2]
    return put_state(others, replace(end, log_odds=best.log_odds + log_ratio(float(second), float(first))))


def move_on(pose: Pose, before: Frame, frame: Frame) -> Pose:
    """Return where the camera is at a frame by the odometry, if there is one, from its pose at another."""
    if frame.odometry is None or before.odometry is None:
        return pose
    return carry(frame.odometry, before.odometry, pose)


def find_from(query: Query, f: Follower, time: float, motion: Motion) -> Found | None:
    """Find a frame from the pose of another: by descents from there, or by a search around."""
    state = follow(query, f, time, motion)
    if state is not None and state.log_odds >= MOST_EXPECTED:
        return Found(state, "tracked")
    near = find_near(query, f, time, motion)
    if state is None:
        return near
    if near is not None and near.state.log_odds > state.log_odds:
        if is_same_place(near.state.pose, state.pose):
            return Found(near.state, "tracked")
        if near.is_alone:
            return near
    return Found(state, "tracked")


def follow(query: Query, f: Follower, time: float, motion: Motion) -> State | None:
    """Descend from a predicted pose; None if there is no end, or nobody reaches it."""
    start = f.pose
    reach = radius = motion.max_speed * abs(time - f.time) + REACH_SLACK
    if f.earlier is not None and f.time != f.earlier_time:
        start = predict(f.pose, f.earlier, (time - f.time) / (f.time - f.earlier_time), reach)
        radius = min(reach, motion.max_acceleration * (time - f.time) ** 2 + REACH_SLACK)
    end = track(query, start)
    if end is None:
        return None
    moves = [float(np.linalg.norm(end.pose.center_world - at.center_world)) for at in (start, f.pose)]
    return end if moves[0] <= radius and moves[1] <= reach else None


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


def track(query: Query, start: Pose) -> State | None:
    """Descend from a pose, and from poses around the end if it is not sure.

    None if the end more likely is wrong than right, or the photo mirrored.
    """
    fit = descend_fine(query, descend_middle(query, start).pose)
    end = descend_last(query, fit.pose)
    if end.log_odds < SURE_ODDS:
        around = descend_fine(query, perturb_middle(query, end.pose).pose)
        if around.score > fit.score:
            end = max(end, descend_last(query, around.pose), key=lambda state: state.log_odds)
    return None if end.log_odds < 0.0 or is_mirrored(query, end.pose) else end


def descend_last(query: Query, start: Pose) -> State:
    """Descend on the points themselves; return the end, with its odds by whole views."""
    pose = descend(query.points_at(start), query.photo.images.full(), start, FULL_LIMITS)
    end = score_pose(query, pose)
    is_near = np.linalg.norm(pose.center_world - start.center_world) < NEARLY
    covariance = None
    if end.score >= HOPELESS_SCORE:
        covariance = estimate_covariance(query, pose, seen_from=start if is_near else None)
    standings = assess_poses(replace(query, num_parts=0), end, [])
    probability = float(posterior(standings, covariance)[0])
    return State(pose, log_odds_of_place(probability, probability, covariance), end.score, covariance)


def find_near(query: Query, f: Follower, time: float, motion: Motion) -> Found | None:
    """Search by whole views within walking distance of a pose.

    None if no pose is sure, or the distance is too great: then the whole scan is to be searched.
    """
    radius = motion.max_speed * abs(time - f.time) + REACH_SLACK
    if radius > MAX_RADIUS:
        return None
    x, y, z = (float(value) for value in query.scan_map.to_world(f.pose).center_world)
    some = apply_prior(query.scan_map, Prior(near_world=(x, y, z), radius=radius))
    if len(some.sparse) == 0:
        return None
    level = f.pose.R_cam_from_world @ uniform_yaws(query.settings.num_yaws)
    close = replace(query, scan_map=some, cache=Cache(query.cache.views), num_parts=0, rotations=level)
    first = brief_query(close)
    ends = refine(first, search_poses(first, "known"), NEAR_BEAM)
    found = rank([h for h in ends if np.linalg.norm(h.pose.center_world - f.pose.center_world) <= radius])
    state = track(query, found.best.pose)
    if state is None or state.log_odds < MOST_EXPECTED:  # it is not where it was to be expected
        return None
    behind = [log_behind(query, h.score / max(found.best.score, 1e-9)) for h in found.alternatives]
    return Found(state, "near", max(behind, default=-np.inf) <= -COPY_LOG_ODDS)
