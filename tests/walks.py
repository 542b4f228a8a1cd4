"""A walk through a room: its frames, a video of them, and how it is localized."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import rooms

from piccolo.cli import localize
from piccolo.geometry.pose import Pose, pose_errors, yaw_rotation
from piccolo.system.jobs.threads import Workers
from research.synthetic.walk_frames import writing_video
from research.synthetic.world import free_position, photograph

SEED = 3
NUM_FRAMES = 8
STEP_S = 0.5


class Taken(NamedTuple):
    image: Path
    pose: Pose
    time: float


def walk_through(world):
    """Poses from one free place of a room to the farthest of some others, turning a little."""
    rng = np.random.default_rng(4)
    room = world.rooms[0]
    start, *others = (free_position(room, rng, (1.4, 1.5)) for _ in range(12))
    end = max(others, key=lambda place: np.linalg.norm(place - start))
    end = start + (end - start) / np.linalg.norm(end - start) * 1.6
    shares = np.linspace(0.0, 1.0, NUM_FRAMES)
    return [Pose(yaw_rotation(0.3 + 0.8 * s), start + s * (end - start)) for s in shares]


def list_frames(folder):
    """The frames of the walk, in a folder."""
    poses = walk_through(rooms.room(SEED)[0])
    return [Taken(folder / "images" / f"{k:02}.png", pose, STEP_S * k) for k, pose in enumerate(poses)]


def _write_frames(folder):
    (folder / "images").mkdir(parents=True)
    room = rooms.room(SEED)[0].rooms[0]
    with writing_video(folder / "walk.mp4", 1 / STEP_S, (rooms.WIDTH, rooms.WIDTH // 2)) as add:
        for frame in list_frames(folder):
            rgb = photograph(room, frame.pose, rooms.WIDTH, Workers(2))
            cv2.imwrite(str(frame.image), rgb[..., ::-1])
            add(rgb)


def write_walk():
    """The folder with the frames and the video, which one worker writes for all."""
    return rooms.make_once("a walk", _write_frames)


def assert_right(results, frames):
    """Each frame is localized where it was taken."""
    assert [result.status for result in results] == ["localized"] * len(frames)
    errors = [pose_errors(r.pose, frame.pose) for r, frame in zip(results, frames, strict=True)]
    assert max(distance for distance, _ in errors) < 0.03
    assert np.degrees(max(angle for _, angle in errors)) < 0.5


def run_localize(*words):
    """Run localize.py on the scan of the room; returns the exit code."""
    cloud = ["--cloud", str(rooms.map_path(SEED)), "--gravity", "known", "--quiet"]
    return localize.main([*cloud, *words])
