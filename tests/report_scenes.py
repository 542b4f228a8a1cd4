"""A made-up house of two storeys with photos, and results of all kinds, for tests of reports."""

import base64
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from piccolo.api.photo_reader import unreadable_result
from piccolo.apps.report import report
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.judge.belief import make_belief
from piccolo.judge.pose_covariance import PoseCovariance
from piccolo.judge.result import Result
from piccolo.judge.result_parts import Alternative, Evidence, Gap, Source, WalkFrame
from piccolo.photo.panorama.picture import encode_image
from piccolo.system.jobs.threads import Workers
from research.synthetic.world import make_world, photograph, pose_of_query, scan_world

SIZE = np.array([4.5, 3.5, 2.5])
STOREY = 3.0  # [m] from floor to floor
NUM_ROOMS = 4
POINTS = 30_000  # of a storey
EVIDENCE = Evidence(0.82, 0.6, 0.85, 0.9, 0.83, 0.04)
HOSTILE = (
    "<img src=x onerror=alert(1)>.jpg",
    "</script><script>window.injected=1</script>.jpg",
    "\"'`${alert(1)}--><!--.jpg",
    "&lt;b&gt; %3Cscript%3E #photo=x&view=0,0,1 \\u003c.jpg",
)


class House:
    """Two worlds, one above the other: the cloud of both, and photos with the poses they were taken at."""

    def __init__(self, folder, width=256):
        self.folder = Path(folder)
        self.width = width
        self.worlds = [make_world(seed, SIZE, NUM_ROOMS) for seed in (11, 12)]
        self.cloud = self.folder / "house.npz"
        self.results = []

    def write_cloud(self):
        parts = [scan_world(world, POINTS, Workers(2)) for world in self.worlds]
        lifted = [points + np.float32([0, 0, STOREY * k]) for k, (points, *_) in enumerate(parts)]
        colors = np.concatenate([colors for _, colors, _ in parts])
        np.savez(self.cloud, points=np.concatenate(lifted), colors=colors)

    def pose(self, index):
        """Storey, room and pose of a photo; those of even numbers are below."""
        storey = index % 2
        room, pose, _ = pose_of_query(self.worlds[storey], index // 2, "clean")
        return storey, room, pose

    def add(self, index, name=None, status="localized", **more):
        """Take a photo, and say what was found of it."""
        storey, room, pose = self.pose(index)
        path = self.folder / "photos" / (name or f"{index:03}.jpg")
        path.parent.mkdir(exist_ok=True)
        if status != "unreadable" and not path.exists():
            path.write_bytes(encode_image(photograph(room, pose, self.width, Workers(2)), ".jpg", 90))
        self.results.append(result_of(path, lifted(pose, storey), status, **more))

    def add_walk(self, num_frames):
        """Frames of a walk through a room of the lower storey; returns their lines."""
        room = self.worlds[0].rooms[0]
        start = self.pose(0)[2]
        middle = room.corner + room.size / 2
        lines = []
        for k in range(num_frames):
            at = middle + np.array([0.9 * np.cos(0.5 * k), 0.6 * np.sin(0.5 * k), 0.0])
            at[2] = start.center_world[2]
            pose = Pose(yaw_rotation(0.5 * k + np.pi / 2), at)
            path = self.folder / "photos" / f"walk_{k}.jpg"
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(encode_image(photograph(room, pose, self.width, Workers(2)), ".jpg", 90))
            walk = WalkFrame(1.5 * k, k, "tracked", None, Gap(9.0, 1.5) if k == 4 else None)
            lines.append(replace(result_of(path, pose), walk=walk).to_json())
        return lines

    def write_results(self, name="poses.jsonl", lines=None):
        path = self.folder / name
        lines = [result.to_json() for result in self.results] if lines is None else lines
        path.write_text("\n".join(lines) + "\n")
        return path


def lifted(pose, storey):
    return Pose(pose.R_cam_from_world, pose.center_world + np.array([0.0, 0.0, STOREY * storey]))


def result_of(path, pose, status="localized", confidence=None, alternatives=()):
    """A result as localize.py would write it."""
    if status == "unreadable":
        return unreadable_result(f"{path}: no picture", "house.npz", str(path), settings={})
    likely = {"localized": 0.995, "ambiguous": 0.55, "not_localized": 0.12}[status]
    spread = np.diag([1e-7, 1e-7, 1e-7, 4e-6, 1e-6, 1e-6]) * (1 if status == "localized" else 2500)
    likely = likely if confidence is None else confidence
    return Result(
        status=status,
        confidence=likely,
        belief=make_belief([likely, *(p for _, p in alternatives)]),
        cloud="house.npz",
        pano=str(path),
        best_pose=pose,
        loss=0.02,
        evidence=EVIDENCE,
        alternatives=tuple(Alternative(other, 0.4, 9, p) for other, p in alternatives),
        covariance=PoseCovariance(spread, "heading 90 or 270 deg"),
        seconds={"search": 1.0},
        settings={"preset": "default"},
        probability_none=0.005,
        source=Source(image_size=(256, 128), capture_time="2026-03-01T10:00:00"),
    )


def mixed_house(folder, num_photos, width=256):
    """A house with photos of every status, the walk of six frames; its result files."""
    house = House(folder, width)
    house.write_cloud()
    for k in range(num_photos - 6):
        if k % 25 == 7:
            others = [(lifted(house.pose(k + 2 * n)[2], k % 2), p) for n, p in ((1, 0.3), (2, 0.1))]
            house.add(k, status="ambiguous", alternatives=others)
        elif k % 25 == 12:
            house.add(k, status="not_localized")
        elif k % 60 == 19:
            house.add(k, status="unreadable")
        else:
            house.add(k, confidence=0.9 + 0.099 * (k % 10) / 9)
    walk = house.write_results("walk.jsonl", house.add_walk(6))
    return house, [house.write_results(), walk]


def run_report(house, out, *more):
    house, results = house
    words = ["--results", *map(str, results), "--cloud", str(house.cloud), "--quiet", "--jobs", "2"]
    return report.main([*words, "--out", str(out), *more])


def document_of(out):
    text = (out / "report.js").read_text()
    return json.loads(text.removeprefix("window.PICCOLO_REPORT = ").removesuffix(";\n"))


def photo_named(document, name):
    return next(photo for photo in document["photos"] if photo["name"] == name)


def pictures_of(out, photo):
    text = (out / "photos" / f"{photo['key']}.js").read_text()
    return json.loads(text.partition(" = ")[2].removesuffix(";\n"))


def decode_picture(text):
    return cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)
