"""A descent as moving pictures: panorama, cloud from each pose that it passes, checkerboard of both."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..errors import InputError
from ..geometry.pose import Pose, step
from ..panorama import Panorama
from ..panorama.texels import Texels
from ..render.overlay import compared, photo_of
from ..render.surfel_renderer import closed, draw, encoded, evenly, not_hidden
from ..render.surfels import surfels_of
from ..runtime.atomic import replacing_folder, write_atomically
from ..runtime.optional import import_optional
from ..runtime.threads import Workers
from .refine import Refined, refine, sampling_loss_of
from .settings import DescentSettings

FRAME_WIDTH = 512
TEXT_HEIGHT = 24
MAX_SURFELS = 150_000  # about one a pixel
MAX_FRAMES = 60  # more poses are thinned out evenly
FRAMES_PER_S = 8
HOLD = 12  # frames for which the last stands

Frames = Sequence[NDArray[np.uint8]]  # (H, W, 3) RGB each, all of one size


@dataclass(frozen=True)
class Passed:
    """A pose that a descent took."""

    iteration: int
    pose: Pose
    loss: float


def shaken(pose: Pose, distance: float, angle_deg: float, seed: int) -> Pose:
    """`pose` moved by `distance` [m] and turned by `angle_deg`, each in a direction drawn at random."""
    rng = np.random.default_rng(seed)
    turn, move = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return step(pose, np.concatenate([np.radians(angle_deg) * turn, distance * move]))


def watched_descent(
    points: PackedPoints, texels: Texels, start: Pose, settings: DescentSettings
) -> tuple[Refined, list[Passed]]:
    """`refine`, and the poses that it passed, without those that a line search or damping tried in vain."""
    passed: list[Passed] = []
    num_tried, least, last_part = 0, np.inf, -1

    def watch(part: int, pose: Pose, loss: float) -> None:
        nonlocal num_tried, least, last_part
        least = loss if part != last_part else min(least, loss)
        if settings.solver == "adam" or loss == least:
            passed.append(Passed(num_tried, pose, loss))
        num_tried, last_part = num_tried + 1, part

    refined = refine(points, sampling_loss_of(texels), start, settings, watch)
    passed.append(Passed(num_tried, refined.pose, refined.loss))
    return refined, passed


def frames_of(
    points: PackedPoints, panorama: Panorama, passed: Sequence[Passed], width: int, workers: Workers
) -> list[NDArray[np.uint8]]:
    """A picture a pose, with iteration and loss written on top."""
    ends = [not_hidden(points, p.pose.center_world) for p in (passed[0], passed[-1])]
    surfels = surfels_of(points.take(evenly(np.union1d(*ends), MAX_SURFELS)), workers)
    photo = photo_of(panorama, width)
    chosen = np.unique(np.linspace(0, len(passed) - 1, min(MAX_FRAMES, len(passed))).astype(int))

    def frame(k: int) -> NDArray[np.uint8]:
        cloud = closed(draw(surfels, passed[k].pose, width, Workers(1)))
        bar = np.zeros((TEXT_HEIGHT, width, 3), np.uint8)
        text = f"iteration {passed[k].iteration}   loss {passed[k].loss:.4f}"
        cv2.putText(bar, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        return np.concatenate([bar, compared(photo, cloud)])

    return list(workers.each(frame, chosen.tolist(), "frames"))


def check_animation(path: Path) -> None:
    """Refuse, before any work is done, a kind that can't be written here."""
    if path.suffix.lower() == ".gif":
        import_optional(path, "PIL.Image")


def write_animation(path: Path, frames: Frames) -> None:
    """Write a GIF or an MP4 by its suffix, or pictures into a new folder; whole or not at all."""
    kind = path.suffix.lower()
    if kind in (".gif", ".mp4"):
        held = [*frames, *[frames[-1]] * HOLD]
        write_atomically(path, _gif(path, held) if kind == ".gif" else _mp4(path, held))
        return
    with replacing_folder(path) as folder:
        for k, frame in enumerate(frames):
            (folder / f"{k:04d}.png").write_bytes(encoded(frame, ".png"))


def _gif(path: Path, frames: Frames) -> bytes:
    pillow = import_optional(path, "PIL.Image")
    first, *others = (pillow.fromarray(frame) for frame in frames)
    file = BytesIO()
    duration = 1000 // FRAMES_PER_S
    first.save(file, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    return file.getvalue()


def _mp4(path: Path, frames: Frames) -> bytes:
    height, width = (size // 2 * 2 for size in frames[0].shape[:2])  # the codec takes even sizes only
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        part = Path(folder) / "part.mp4"
        writer = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_S, (width, height))
        for frame in frames:
            writer.write(cv2.cvtColor(frame[:height, :width], cv2.COLOR_RGB2BGR))
        writer.release()
        content = part.read_bytes() if part.exists() else b""
    if not content:
        raise InputError(f"{path}: found no MP4 encoder in this OpenCV, wanted .gif or a folder")
    return content
