"""A camera followed through a scan: frame by frame, each by what is known so far."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..confidence.alternatives import Hypothesis
from ..geometry.pose import Pose
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..localization.localize import localize
from ..localization.prior import apply_prior
from ..localization.query import Query, prepare_query
from ..localization.selection import CLEAR_SCORE
from ..localization.settings import CoarseToFineSettings
from ..panorama import Panorama
from ..scan_map.scan_map import ScanMap
from .frames import MAX_STEP, NO_ACCELERATION, Frame, Motion, State, centers_of, states_of
from .free_space import FreeSpace
from .path import REACH_SLACK, Lattice
from .tracking import (
    KEPT_BESIDE,
    LEAST_KEPT,
    LEAST_SCORE,
    beside,
    found_everywhere,
    found_near,
    predicted,
    states_at,
    tracked,
    tracked_on,
)

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
    """The forward half of a walk: needs no future, and keeps what it found."""

    def __init__(
        self,
        scan_map: ScanMap,
        settings: CoarseToFineSettings,
        workers: Workers,
        motion: Motion,
        space: FreeSpace | None = None,
    ) -> None:
        self.scan_map = apply_prior(scan_map, settings.prior)
        self.settings = settings
        self.workers = workers
        self.motion = motion
        self.lattice = Lattice(space or FreeSpace(scan_map, workers), motion)
        self.num_lost = 0
        self.next_search = 1
        self.walked = 0.0  # [m] since the whole scan was searched
        self.is_sure = False

    @property
    def frames(self) -> list[Frame]:
        """All so far."""
        return self.lattice.frames

    def forget_times(self) -> None:
        """Of frames of which only the order is known: their times are numbers. Before the first one."""
        step = MAX_STEP if self.motion.is_guess else self.motion.max_speed
        self.motion = replace(self.motion, max_speed=step, max_acceleration=NO_ACCELERATION, is_timed=False)
        self.lattice = Lattice(self.lattice.space, self.motion)

    def prepared(self, panorama: Panorama) -> Query:
        """The query of a frame, with the images that its descents need."""
        query = prepare_query(panorama, self.scan_map, self.settings, self.workers)
        query.photo.make_images()
        return query

    @one_blas_thread
    def add(self, panorama: Panorama, query: Query, time: float) -> Frame:
        """Find the next frame, whose query is prepared."""
        frame = Frame(time)
        if panorama.is_valid.any() and len(self.scan_map.centers) > 0:
            is_far = self._reach(frame) >= FAR
            self._follow(query, frame, not is_far)
            is_lost = self.num_lost + 1 >= self.next_search
            is_due = self.walked + self._moved(frame) >= (CHECKED_SURE if self.is_sure else CHECKED_UNSURE)
            if is_far or (is_lost and not frame.is_credible):
                self._search(query, panorama, frame)
            elif is_due and frame.is_credible:
                self._check(query, frame)
        self.accept(frame)
        return frame

    def accept(self, frame: Frame) -> None:
        """Count a frame that was found now or earlier."""
        self.walked += self._moved(frame)
        self.lattice.add(frame)
        if frame.how == "alone":
            self.walked = 0.0
        if frame.is_credible:
            self.num_lost = 0
            self.next_search = FIRST_SEARCH
            self.is_sure = bool(self.lattice.filtered().max() >= SURE)
            return
        self.num_lost += 1
        if frame.how == "alone":
            self.next_search = self.num_lost + min(max(self.num_lost, FIRST_SEARCH), LAST_SEARCH)

    def _reach(self, frame: Frame) -> float:
        """Metres that the camera may have gone since the frame before."""
        seconds = frame.time - self.frames[-1].time if self.frames else 0.0
        return self.motion.max_speed * seconds

    def _moved(self, frame: Frame) -> float:
        """Metres from the frame before, from its nearest pose; 0 if one of the two has none."""
        before = next((f for f in reversed(self.frames) if f.states), None)
        if before is None or not frame.states:
            return 0.0
        best = max(frame.states, key=lambda state: state.log_odds).pose.center_world
        return float(np.linalg.norm(centers_of(before.states) - best, axis=1).min())

    def _follow(self, query: Query, frame: Frame, looks_near: bool) -> None:
        """Descend from where the camera should be by each of its last poses, or look near these."""
        followers = self.followers()
        if not followers:
            return
        ends = followed(query, followers, frame.time, self.motion)
        is_there = any(end.score >= least_score(f) for f, end in zip(followers, ends, strict=True))
        least = KEPT_BESIDE * max(end.score for end in ends) if is_there else CLEAR_SCORE
        found = [end for end in ends if end.score >= least] if is_there else []
        lost = [f for f, end in zip(followers, ends, strict=True) if not is_there or end.score < least]
        for f in lost[:MOST_SOUGHT] if looks_near else []:
            radius = self.motion.max_speed * (frame.time - f.time) + REACH_SLACK
            if radius <= MAX_RADIUS:
                found += found_near(query, f.state.pose, radius, least)
        if found:
            frame.put(states_at(query, found), "tracked" if is_there else "near")

    def followers(self) -> list[Follower]:
        """The poses from which the next frame may come: of the last that is credible, then of later ones."""
        known = [k for k, frame in enumerate(self.frames) if frame.states]
        credible = [k for k in known if self.frames[k].is_credible][-1:]
        later = [k for k in known[-1:] if k not in credible]
        return [f for k in (*credible, *later) for f in self._followers_of(k, known)][:MOST_TRACKED]

    def _followers_of(self, k: int, known: list[int]) -> list[Follower]:
        """The poses of a frame, the likeliest first."""
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
        """Look for a frame that is followed in the whole scan too."""
        found = found_everywhere(query, CLEAR_SCORE)
        if found:
            frame.put(merged(query, frame.states, found), "alone")

    def _search(self, query: Query, panorama: Panorama, frame: Frame) -> None:
        """Search the whole scan, and keep what was tracked beside."""
        alone = localize(self.scan_map, panorama, self.settings, self.workers, Stopwatch())
        tracked_to = [Hypothesis(state.pose, state.score) for state in frame.states]
        states = states_of(self.scan_map, alone)
        frame.put(merged(query, states, tracked_to) if states else frame.states, "alone")
        frame.alone = alone


def merged(query: Query, states: list[State], others: Sequence[Hypothesis]) -> list[State]:
    """The states of a frame, and other poses beside them."""
    for other in others:
        more = beside(query, states, other)
        states = states if more is None else [*states, more]
    return states


def least_score(f: Follower) -> float:
    """What a frame must explain to be there where it was followed."""
    return max(LEAST_SCORE, LEAST_KEPT * f.state.score)


def followed(query: Query, followers: Sequence[Follower], time: float, motion: Motion) -> list[Hypothesis]:
    """Where each of some poses leads, worked out beside each other; the query's images are made."""
    return list(query.workers.map(lambda f: follow(query, f, time, motion), followers, "descend"))


def follow(query: Query, f: Follower, time: float, motion: Motion) -> Hypothesis:
    """Descend from where a camera should be; farther around if it may be far, or explains less."""
    least = least_score(f)
    seconds = time - f.time
    starts = [f.state.pose]
    span = f.time - f.earlier_time
    if f.earlier is not None and span != 0.0:
        reach = motion.max_speed * abs(seconds) + REACH_SLACK
        starts.insert(0, predicted(f.state.pose, f.earlier, seconds / span, reach))
    end = tracked(query, starts[0], least)
    if end.score < least:
        end = max([end, *(tracked(query, start, least) for start in starts[1:])], key=lambda h: h.score)
    is_usual = end.score >= USUAL * f.state.score and motion.max_speed * abs(seconds) < SHORT
    return end if is_usual or end.score < least else tracked_on(query, end)
