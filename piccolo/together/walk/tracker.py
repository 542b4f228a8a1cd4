"""Tracking of a camera through a scan, frame by frame, from past frames only."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import compress

from ...evidence.verification import match_beside, place_keypoints
from ...geometry.nearness import ONE_PLACE, RIGHT
from ...geometry.pose import Pose
from ...geometry.pose_gaussian import PoseGaussian
from ...localization.attempts import can_look_first
from ...localization.means import Means
from ...localization.run import localize
from ...photo.panorama import Panorama
from ...problem.photo_cone import find_cone
from ...problem.prior import apply_prior
from ...problem.problem import Problem, prepare_problem
from ...problem.settings import CoarseToFineSettings
from ...scan_map.camera_positions import FreeSpace
from ...scan_map.scan_map import ScanMap
from ...system.jobs.threads import Stopwatch, Workers, one_blas_thread
from .expectation import Followed, expect
from .following import KnownPoses, find_near, refine_state
from .frames import REACH_SLACK, Frame, Motion, list_states, put_state
from .path import EVEN, Lattice
from .places import fits_mirror, list_key_states

Read = Callable[[int], Panorama | None]  # the picture of a frame; None if it can't be read
MOST_KNOWN = 2  # chosen: former poses of a frame within reach, from which it is tracked again
NUM_KEPT = 4  # frames whose problems are kept: those used last
BETWEEN_KEYS = ONE_PLACE.distance  # [m] between key frames, at least
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
        self.read: Read = lambda k: None  # `api.scan_walk.Walk` puts its own here
        self.means = Means(settings.effort, workers, Stopwatch())
        self.problems: dict[int, Problem] = {}  # by the number of the frame
        self.found_at: float = -math.inf  # time when the camera was last found; before, of the first search
        self.next_search: float = 0.0  # [m] reach since `found_at` at which all places are searched again

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
        """Localize the next frame, whose problem is prepared; the first call computes the free space."""
        frame = Frame(time, odometry=odometry)
        if panorama.is_valid.any() and len(self.scan_map.centers) > 0:
            self._keep(len(self.frames), problem)
            self.lattice.space.prepare()
            self._find(problem, frame)
        self.lattice.add(frame)
        if frame.is_key:
            self._depart(problem, frame)
        self._note(frame)
        return frame

    def _find(self, problem: Problem, frame: Frame) -> None:
        """Find the next frame from the last one, or anywhere."""
        is_known = frame.odometry is not None or not self.frames
        is_far = not is_known and self.motion.reach(frame.time - self.frames[-1].time) > ELSEWHERE
        if not is_far:
            self._follow(problem, frame)
        is_lost = not frame.states and self.motion.reach(frame.time - self.found_at) >= self.next_search
        if is_far or is_lost or (frame.states and self._is_doubtful(problem, frame)):
            self.search(problem, frame)
        if frame.states and not frame.is_key and self._is_telling(frame):
            frame.states = list_key_states(problem, frame.states, self.means)
            frame.is_key = True

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

    def _is_doubtful(self, problem: Problem, frame: Frame) -> bool:
        """Return True if the place from which a frame was tracked is doubtful, and the frame shows more.

        A photo of a part of the sphere shows more if it looks in another direction than the key frames
        nearby: then it is further evidence.
        """
        key = self._last_key()
        if key is None or not problem.profile.is_partial or not self._shows_more(problem, frame):
            return False
        likeliest = self.lattice.filter_path().probabilities[key].max()
        return bool(likeliest < self.settings.min_confidence)

    def _shows_more(self, problem: Problem, frame: Frame) -> bool:
        """Return True if a frame is turned by half of its field of view against all key frames nearby."""
        cone = find_cone(problem.photo.image(problem.profile.first.image), margin=0.0)
        k = frame.key
        while k is not None and frame.arrived and (pose := self.frames[k].tracking_pose):
            axis, other = (R.T @ cone.axis for R in (frame.arrived.R_cam_from_world, pose.R_cam_from_world))
            if frame.arrived.distance(pose) < BETWEEN_KEYS and axis @ other > cone.cos_angle:
                return False
            k = self.frames[k].key
        return True

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
        of_others: Sequence[PoseGaussian | None] = ()
        if problem.profile.is_narrow:
            sure = [(k, pose) for k, pose in near if self.frames[k].is_sure]
            others = [(k, other, pose) for k, pose in sure if (other := self.problem_of(k))]
            located = (place_keypoints(other, pose, self.workers) for _, other, pose in others)
            beside = tuple(match_beside(problem, one, self.workers) for one in located)
            problem = replace(problem, beside=beside)
            of_others = [self._gaussian_at(k, pose) for k, _, pose in others]
        expected = expect(frame, [(self.frames[k], pose) for k, pose in near], self.motion)
        known = [state.pose for state in frame.states if expected.is_within(state.pose)]
        return find_near(problem, expected, self.means, KnownPoses(known[:MOST_KNOWN], of_others))

    def _gaussian_at(self, k: int, pose: Pose) -> PoseGaussian | None:
        """Return frame k's pose with its covariance if that pose is `pose`; else None."""
        gaussian = self.frames[k].states[0].gaussian
        return gaussian if gaussian and RIGHT.holds(gaussian.pose, pose) else None

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

    def search(self, problem: Problem, frame: Frame) -> None:
        """Search the whole scan for a frame, which becomes a key frame if anything is found.

        If the photo is not sure by itself, its poses by tracking are kept.
        """
        frame.alone = localize(self.scan_map, problem.source, self.settings, self.means)
        is_sure = frame.is_localized_alone
        is_mirrored = not is_sure and can_look_first(problem) and fits_mirror(problem, self.means)
        if found := [] if is_mirrored else list_states(self.scan_map, frame.alone):
            tracked = [] if is_sure else frame.states
            own = found[:1] if is_sure else sorted([*found, *tracked], key=lambda state: -state.log_odds)
            frame.how = "alone" if own[0] is found[0] else frame.how
            frame.states = list_key_states(problem, own, self.means, frame.alone)
            frame.is_key = True

    def _depart(self, problem: Problem, frame: Frame) -> None:
        """Refine the likeliest place of a key frame; if it is likely, the next frames are tracked from it.

        Of several about equally likely places, as copies are, the one that looks best is taken.
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
