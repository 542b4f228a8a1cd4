"""Frames of videos as players show them."""

import struct

import av
import numpy as np
import pytest
from refusals import assert_input_error

from piccolo.photo.panorama.picture import read_picture
from piccolo.photo.panorama.video import frames_at, frames_of, frames_of_chapters
from research.synthetic.walk_frames import writing_video

MATRICES = {  # of the track, by the turn to the right that players make [deg]
    90: (0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30),
    180: (-65536, 0, 0, 0, -65536, 0, 0, 0, 1 << 30),
    270: (0, -65536, 0, 65536, 0, 0, 0, 0, 1 << 30),
}
COLORS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)
SHOWN = np.repeat(np.repeat(COLORS, 80, axis=0), 160, axis=1)  # (160, 320, 3)


def write_turned(path, turn_deg):
    """A video whose frames are stored turned, as a phone does, with the turn that makes them upright."""
    stored = np.ascontiguousarray(np.rot90(SHOWN, turn_deg // 90))
    with writing_video(path, 4.0, (stored.shape[1], stored.shape[0])) as add:
        for _ in range(6):
            add(stored)
    content = bytearray(path.read_bytes())
    place = content.find(b"tkhd") + 44  # version 0: its fields before the matrix
    assert struct.unpack_from(">9i", content, place)[0] == 65536
    struct.pack_into(">9i", content, place, *MATRICES[turn_deg])
    path.write_bytes(content)


@pytest.mark.parametrize("turn_deg", MATRICES)
def test_frames_are_turned_as_players_show_them(tmp_path, turn_deg):
    path = tmp_path / "a.mp4"
    write_turned(path, turn_deg)
    frames = [*frames_of(path, 0.5, tmp_path), *frames_at(path, [0.25], tmp_path)]
    assert len(frames) >= 3
    for frame in frames:
        rgb = read_picture(frame.path).rgb.astype(int)
        assert rgb.shape == SHOWN.shape
        assert np.abs(rgb - SHOWN)[40::80, 80::160].max() < 40


def test_chapters_follow_one_another(tmp_path):
    """Two of one name, of 1.5 s each; their frames keep the names of both."""
    videos = [tmp_path / name / "a.mp4" for name in ("first", "second")]
    for video, turn_deg in zip(videos, (90, 180), strict=True):
        video.parent.mkdir()
        write_turned(video, turn_deg)
    frames = list(frames_of_chapters(videos, 0.5, tmp_path))
    half = len(frames) // 2
    assert half >= 3
    assert [video for video, *_ in frames] == [videos[0]] * half + [videos[1]] * half
    own = [frame.time for _, frame, _ in frames]
    assert [time for *_, time in frames] == own[:half] + [1.5 + time for time in own[half:]]
    assert len({frame.path for _, frame, _ in frames}) == len(frames)


def test_two_lenses_in_one_video_are_refused(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("libx264", 4) for _ in range(2)]
        for stream in streams:
            stream.width = stream.height = 160
            stream.pix_fmt = "yuv420p"
        for stream in streams:
            for _ in range(4):
                frame = av.VideoFrame.from_ndarray(np.full((160, 160, 3), 90, np.uint8), format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    message = "a.mp4: found 2 videos of 160 x 160, of one lens each, wanted one that the camera's program"
    assert_input_error(message, lambda: list(frames_of(path, 0.5, tmp_path)))
