"""Parts of a walk: its longest step, how sure a frame is, times from names, tables and EXIF."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from piccolo.batch.frame_times import times_of
from piccolo.confidence.localization import Localization
from piccolo.errors import InputError
from piccolo.geometry.pose import Pose
from piccolo.walk.frames import MAX_STEP, NO_ACCELERATION, Frame, Motion, State
from piccolo.walk.localize import accuracy_of
from piccolo.walk.second_look import motion_of


def test_the_longest_step_is_told_by_the_frames_that_are_localized_alone():
    def frame(x, status="localized"):
        return Frame(0.0, alone=Localization(status=status, pose=Pose(np.eye(3), np.array([x, 0.0, 0.0]))))

    frames = [
        *(frame(6.0 * (k // 2)) for k in range(40)),
        frame(500.0),
        frame(900.0, "ambiguous"),
        Frame(0.0),
    ]
    guess = Motion(MAX_STEP, NO_ACCELERATION, is_timed=False, is_guess=True)

    def longest(motion, frames):
        return motion_of(SimpleNamespace(motion=motion, frames=frames)).max_speed

    assert longest(guess, frames) == pytest.approx(9.0)
    assert longest(guess, [frame(0.0), frame(1.0)]) == MAX_STEP
    assert longest(guess, [Frame(0.0)]) == MAX_STEP
    assert longest(replace(guess, is_guess=False), frames) == MAX_STEP
    assert longest(replace(guess, is_timed=True), frames) == MAX_STEP


def test_a_frame_is_as_sure_as_its_own_picture():
    """Those around it tell the place of a blurred frame, but not where in it."""

    def state(odds):
        return State(Pose(np.eye(3), np.zeros(3)), odds, 0.5)

    assert accuracy_of(Frame(0.0, [state(0.0)])) == pytest.approx(0.5)
    assert accuracy_of(Frame(0.0, [state(2.0), state(2.0)])) == pytest.approx(1 / (1 + np.exp(-2.0) / 2))


def test_times_by_names_tables_and_exif(tmp_path):
    frames = [tmp_path / f"walk_{text}.jpg" for text in ("10.5", "11", "13.25")]
    assert times_of(frames, "names") == [0.0, 0.5, 2.75]
    assert times_of(frames, "order") is None
    assert times_of(frames, None) is None  # no file, no EXIF
    (tmp_path / "t.csv").write_text("name,time\nwalk_10.5.jpg,3\nwalk_11.jpg,4\n")
    assert times_of(frames[:2], str(tmp_path / "t.csv")) == [0.0, 1.0]
    with pytest.raises(InputError, match=r"t\.csv: found no time of .*walk_13\.25\.jpg, wanted a CSV file"):
        times_of(frames, str(tmp_path / "t.csv"))
    (tmp_path / "t.csv").write_text("name,when\na,3\n")
    with pytest.raises(InputError, match=r"t\.csv: found KeyError 'time', wanted a CSV file"):
        times_of(frames, str(tmp_path / "t.csv"))
    with pytest.raises(InputError, match="wanted them to rise"):
        times_of(frames[::-1], "names")
    with pytest.raises(InputError, match=r"^--times names: found no number in walk\.jpg"):
        times_of([tmp_path / "walk.jpg"], "names")
    with pytest.raises(InputError, match=r"^--times exif: found a frame without a time in EXIF"):
        times_of(frames, "exif")
