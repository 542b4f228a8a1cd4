"""The path through a walk's key frames, against the sum over every way there is."""

import itertools
import math

import numpy as np
import pytest
from key_frames import MOTION, Open, make_followed, make_key, make_pose
from refusals import assert_input_error

from piccolo.geometry.pose import Pose, carry, exp_so3, pose_errors, yaw_rotation
from piccolo.poses.times import check_times
from piccolo.system.errors import InputError
from piccolo.together.walk import path as walk_path
from piccolo.together.walk.frames import JUMP_LOG, MOST_EXPECTED, Frame, Motion
from piccolo.together.walk.path import believe


def _naive(frames, share):
    """Probabilities of all frames' states, by going every way there is."""
    emitted = [walk_path.emissions(frame) for frame in frames]
    ways = {}
    for way in itertools.product(*([None, *range(len(frame.states))] for frame in frames)):
        log = 0.0
        before = None
        for k, j in enumerate(way):
            if j is None:
                continue
            log += emitted[k][0][j]
            if before is not None:
                m, i = before
                here, there = (frames[f].states[s].pose.center_world for f, s in ((k, j), (m, i)))
                gap = np.linalg.norm(here - there)
                expected = min(-math.log(share), MOST_EXPECTED + emitted[k][1])
                passed = frames[k].time - frames[m].time
                log += float(walk_path.log_transition(np.array([gap]), passed, MOTION, expected)[0])
            before = k, j
        ways[way] = log
    total = sum(math.exp(log) for log in ways.values())
    found = [np.zeros(len(frame.states)) for frame in frames]
    for way, log in ways.items():
        for k, j in enumerate(way):
            if j is not None:
                found[k][j] += math.exp(log) / total
    return found


def _chosen(path):
    """The likeliest state of each frame."""
    return [path.choose(k) for k in range(len(path.probabilities))]


@pytest.mark.parametrize("seed", range(12))
def test_probabilities_are_those_of_all_ways_there_are(seed):
    rng = np.random.default_rng(seed)
    share = math.exp(-seed / 4)
    frames = []
    for k in range(4):
        num = rng.integers(1, 4)
        states = [(rng.uniform(0.0, 4.0, 3), float(rng.normal(0.5, 3.0))) for _ in range(num)]
        frames.append(make_key(k + 0.3 * rng.random(), *states))
    lattice = walk_path.build_lattice(frames, Open(share), MOTION)
    path = lattice.smooth()
    probabilities = _naive(frames, share)
    for found, wanted in zip(path.probabilities, probabilities, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)
    assert _chosen(path) == [int(p.argmax()) if p.sum() > 0.5 else None for p in probabilities]
    last = lattice.filter_path().probabilities[-1]
    np.testing.assert_allclose(last, probabilities[-1], rtol=1e-9, atol=1e-12)


def test_places_that_look_alike_share_the_evidence():
    copies = [((9.0 * i, 0, 0), 4.0 - 0.9 * walk_path.COPY_LOG_ODDS * (i > 0)) for i in range(5)]
    emitted, log_alike = walk_path.emissions(make_key(0, *copies, ((99, 0, 0), -8.0)))
    np.testing.assert_allclose(emitted[:5], 4.0 - math.log(5.0), atol=1e-3)
    assert log_alike == pytest.approx(math.log(5.0), abs=1e-3)
    assert emitted[5] == pytest.approx(4.0 - 12.0 + walk_path.COPY_LOG_ODDS - log_alike)


def test_twin_rooms_are_told_apart_by_the_place_after_them_and_before_it_are_not():
    """Twenty frames in twin rooms, each a little for the wrong one; then a place that there is once."""
    worse = 3.0 - 0.9 * walk_path.COPY_LOG_ODDS
    twins = [make_key(2.0 * k, ((0.1 * k, 0, 0), worse), ((0.1 * k + 20, 0, 0), 3.0)) for k in range(20)]
    alone = walk_path.build_lattice(twins, Open(), MOTION).smooth()
    np.testing.assert_allclose([p[0] / p.sum() for p in alone.probabilities], 0.5, atol=0.01)
    told = walk_path.build_lattice([*twins, make_key(41.0, ((2.0, 0, 0), 6.0))], Open(), MOTION).smooth()
    assert _chosen(told) == [0] * 21
    assert min(p[0] for p in told.probabilities) > 0.95


def test_a_turn_at_its_end_tells_a_twin_corridor_if_the_motion_is_known():
    """Two corridors alike; from the end of each a copy of a room is in reach, 90 degrees apart."""
    before = make_key(0, ((0, 0, 0), 5.0), ((40, 0, 0), 5.0))
    after = make_key(9, ((6, 0, 0), 5.0), ((40, 6, 0), 5.0))
    unknown = walk_path.build_lattice([before, after], Open(), MOTION).smooth()
    np.testing.assert_allclose(unknown.probabilities[0], 0.5, atol=0.01)
    after.key = 0
    after.arrived = make_pose(6, 0, 0)
    tracked = walk_path.build_lattice([before, after], Open(), MOTION).smooth()
    assert tracked.probabilities[0][0] > 0.99
    after.key = None
    after.arrived = None
    before.odometry = make_pose(100, 0, 0, yaw=1.0)
    after.odometry = make_pose(100, 0, 0, yaw=1.0)
    turn = yaw_rotation(1.0).T
    after.odometry = Pose(after.odometry.R_cam_from_world, turn @ np.array([6.0, 0, 0]) + [100.0, 0, 0])
    measured = walk_path.build_lattice([before, after], Open(), MOTION).smooth()
    assert measured.probabilities[0][0] > 0.99


def test_a_motion_is_carried_to_where_the_camera_is():
    begin = make_pose(1, 2, 3, yaw=0.4)
    end = Pose(exp_so3(np.array([0.1, 0.2, 1.0])), np.array([2.0, 2.5, 3.0]))
    to = Pose(exp_so3(np.array([0.3, -0.2, 2.0])), np.array([-5.0, 0.0, 1.0]))
    carried = carry(end, begin, to)
    motion = np.linalg.solve(begin.T_world_from_cam, end.T_world_from_cam)
    np.testing.assert_allclose(to.T_world_from_cam @ motion, carried.T_world_from_cam, atol=1e-12)
    back = carry(to, carried, end)
    assert pose_errors(back, begin)[0] == pytest.approx(0.0, abs=1e-12)


def test_known_motions_have_the_error_of_their_length():
    frames = [make_key(0, ((0, 0, 0), 5.0)), make_key(1, ((30, 0, 0), 5.0))]
    assert walk_path.motion_between(frames, 0, 1) is None
    frames[0].odometry = make_pose(0, 0, 0)
    frames[1].odometry = make_pose(29, 0, 0)
    moved = walk_path.motion_between(frames, 0, 1)
    assert walk_path.is_moved(moved, frames[0].states, frames[1].states).tolist() == [[True]]
    frames[1].odometry = make_pose(27, 0, 0)
    moved = walk_path.motion_between(frames, 0, 1)
    assert not walk_path.is_moved(moved, frames[0].states, frames[1].states).any()
    frames[1].odometry = make_pose(30, 0, 0, yaw=0.5)
    moved = walk_path.motion_between(frames, 0, 1)
    assert not walk_path.is_moved(moved, frames[0].states, frames[1].states).any()


def test_a_jump_has_a_price_and_is_reported():
    frames = [make_key(k, ((k + 50 * (k > 3), 0, 0), 5.0)) for k in range(8)]
    path = walk_path.build_lattice(frames, Open(), MOTION).smooth()
    assert _chosen(path) == [0] * 8
    assert path.gaps == [None] * 4 + [walk_path.Gap(51.0, 1.0)] + [None] * 3
    lonely = [*frames[:4], make_key(4, ((54, 0, 0), 2.0)), make_key(5, ((5, 0, 0), 5.0))]
    path = walk_path.build_lattice(lonely, Open(), MOTION).smooth()
    assert _chosen(path) == [0, 0, 0, 0, None, 0]
    assert path.probabilities[4][0] < 0.01
    assert walk_path.log_transition(np.array([50.0]), 1.0, MOTION)[0] == JUMP_LOG


def test_frames_without_times_may_be_anywhere_and_report_no_gap():
    motions = Motion(), Motion(is_timed=False), Motion(max_speed=3.0, is_timed=False)
    assert [motion.speed for motion in motions] == [2.0, 5.0, 3.0]
    frames = [make_key(k, ((50.0 * k, 0, 0), 1.0)) for k in range(4)]
    path = walk_path.build_lattice(frames, Open(), Motion(is_timed=False)).smooth()
    assert _chosen(path) == [0] * 4
    assert path.gaps == [None] * 4
    assert _chosen(walk_path.build_lattice(frames, Open(), Motion()).smooth()) == [None] * 4


def test_twins_that_are_as_likely_are_no_gap():
    frames = [make_key(3.0 * k, ((k % 2 * 40, 0, 0), 5.0), ((40 - k % 2 * 40, 0, 0), 5.0)) for k in range(5)]
    path = walk_path.build_lattice(frames, Open(), MOTION).smooth()
    np.testing.assert_allclose([p.max() for p in path.probabilities], 0.5, atol=0.01)
    assert path.gaps == [None] * 5


def test_tracked_frames_are_where_their_key_frame_is_or_are_to_be_tracked_there():
    frames = [make_key(0, ((0, 0, 0), 5.0), ((20, 0, 0), 5.0)), make_followed(1, 0, (1, 0, 0)), Frame(2.0)]
    here = walk_path.build_lattice([*frames, make_key(3, ((2, 0, 0), 6.0))], Open(), MOTION)
    belief = believe(here.frames, here.smooth(), 1)
    assert belief.is_sure
    assert belief.states[0] is frames[1].states[0]
    there = walk_path.build_lattice([*frames, make_key(3, ((22, 0, 0), 6.0))], Open(), MOTION)
    belief = believe(there.frames, there.smooth(), 1)
    assert not belief.is_sure
    np.testing.assert_allclose(belief.expected.center_world, [21.0, 0.0, 0.0])
    assert belief.states[0].pose is belief.expected
    assert belief.probabilities[0] == 0.5
    assert not believe(there.frames, there.smooth(), 2).is_sure


def test_a_tracked_frame_before_a_contradiction_is_less_sure():
    frames = [make_key(0, ((0, 0, 0), 8.0)), make_followed(1, 0, (1, 0, 0)), make_key(2, ((70, 0, 0), 5.0))]
    frames[2].key = 0
    frames[2].arrived = make_pose(2, 0, 0)
    lattice = walk_path.build_lattice(frames, Open(), MOTION)
    path = lattice.smooth()
    assert _chosen(path) == [0, None, None]
    assert believe(frames, path, 1).probabilities[0] < 0.5 < believe(frames, path, 0).probabilities[0]


def test_live_probabilities_are_those_of_the_last_key_frame_that_is_tracked_from():
    frames = [make_key(0, ((0, 0, 0), 5.0)), make_key(1, ((70, 0, 0), -1.0), ((90, 0, 0), -2.0))]
    frames[1].departed = None
    lattice = walk_path.build_lattice([*frames, make_followed(2, 0, (2, 0, 0))], Open(), MOTION)
    path = lattice.filter_path()
    assert _chosen(path) == [0, None, None]
    assert believe(lattice.frames, path, 1).states[0] is frames[1].states[0]
    assert path.probabilities[0][0] == pytest.approx(1.0 / (1.0 + math.exp(-5.0)))
    assert believe(lattice.frames, path, 2).is_sure


def test_tracking_is_known_by_way_of_later_key_frames():
    """The second key frame was left from another place than it was tracked to: its twin."""
    frames = [
        make_key(0, ((0, 0, 0), 5.0)),
        make_key(1, ((1, 0, 0), 5.0), ((31, 0, 0), 5.0), departs=1),
        make_key(2, ((2, 0, 0), 5.0), ((32, 0, 0), 5.0)),
    ]
    frames[1].key = 0
    frames[1].arrived = make_pose(1, 0, 0)
    frames[2].key = 1
    frames[2].arrived = make_pose(32, 0, 0)
    begin, end, _ = walk_path.motion_between(frames, 0, 2)
    np.testing.assert_allclose(end.center_world - begin.center_world, [2.0, 0.0, 0.0])
    lattice = walk_path.build_lattice(frames, Open(), MOTION)
    again = walk_path.build_lattice(frames, Open(), MOTION, lattice)
    for found, wanted in zip(again.smooth().probabilities, lattice.smooth().probabilities, strict=True):
        assert found.tobytes() == wanted.tobytes()
    frames[2].states = frames[2].states[1:]
    changed = walk_path.build_lattice(frames, Open(), MOTION, lattice).smooth()
    assert len(changed.probabilities[2]) == 1


def test_frames_tracked_from_a_dark_key_frame_speak_for_it_when_they_are_known():
    dark = make_key(0, ((0, 0, 0), -1.0))
    alone = walk_path.build_lattice([dark], Open(), MOTION).smooth()
    assert alone.probabilities[0][0] == pytest.approx(1.0 / (1.0 + math.e))
    told = walk_path.build_lattice([dark, make_followed(1, 0, (1, 0, 0), 4.0)], Open(), MOTION).smooth()
    assert told.probabilities[0][0] == pytest.approx(1.0 / (1.0 + math.exp(-4.0)))


def test_frames_that_name_each_other_as_key_frames_measure_nothing():
    """A frame that hangs on a later key frame may have been the key frame of that one before."""
    frames = [
        make_key(0.0, ((0, 0, 0), 5.0)),
        make_followed(1.0, 2, (1, 0, 0)),
        make_followed(2.0, 1, (2, 0, 0)),
    ]
    for frame in frames[1:]:
        frame.departed = make_pose(0, 0, 0)
    assert walk_path.motion_between(frames, 0, 2) is None
    assert walk_path.motion_between(frames, 0, 1) is None


def test_refusals():
    with pytest.raises(InputError, match=r"^times: found 1.0 after 2.0 at frame 2, wanted them to rise$"):
        check_times([0.0, 2.0, 1.0])
    with pytest.raises(InputError, match=r"^times: found one that is no finite number, wanted seconds$"):
        check_times([0.0, np.nan])
    assert_input_error(r"^`max_speed`: found -1.0, wanted a number above 0$", Motion, max_speed=-1.0)


def test_doubtful_frames_that_look_elsewhere_add_up():
    """Each is right with 0.83 by itself; the photos were tracked from each other."""
    frames = [make_key(float(k), ((k, 0, 0), 1.6), ((40 + k, 9 * k, 0), -6.0)) for k in range(4)]
    for k, frame in enumerate(frames[1:]):
        frame.key = k
        frame.arrived = frame.states[0].pose
    sure = [
        walk_path.build_lattice(frames[:n], Open(), Motion(max_speed=1.0, is_timed=False)).smooth()
        for n in range(1, 5)
    ]
    first = [path.probabilities[0][0] for path in sure]
    assert first[0] == pytest.approx(0.83, abs=0.01)
    assert first[1] > 0.95
    assert first == sorted(first)
    assert first[3] > 0.98
