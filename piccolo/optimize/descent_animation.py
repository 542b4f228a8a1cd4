"""An animation of a descent: a checkerboard of the panorama and the cloud at each pose on the way."""

from collections.abc import Sequence
from io import BytesIO
from typing import NamedTuple

import cv2
import numpy as np
import PIL.Image

from ..arrays import Bytes
from ..cloud.soa import PackedPoints
from ..geometry.pose import Pose, step
from ..jobs.threads import Workers
from ..panorama import Panorama
from ..panorama.texels import Texels
from ..views.pictures import checkerboard, fill_holes, resize_rgb
from ..views.surfels import make_surfels, render_surfels, visible_indices
from .refine import DescentSettings, Refined, make_sampling_loss, refine

FRAME_WIDTH = 512
TEXT_HEIGHT = 24
MAX_SURFELS = 150_000  # about one a pixel
MAX_FRAMES = 60  # if there are more poses, this many are drawn, evenly spaced
FRAMES_PER_S = 8
NUM_LAST = 12  # repetitions of the last frame


class Iterate(NamedTuple):
    """A pose on the way of a descent."""

    iteration: int
    pose: Pose
    loss: float


def perturb_pose(pose: Pose, distance: float, angle_deg: float) -> Pose:
    """Move a pose by `distance` [m] and turn it by `angle_deg`, each in a random direction (fixed seed)."""
    rng = np.random.default_rng(0)
    turn, move = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return step(pose, np.concatenate([np.radians(angle_deg) * turn, distance * move]))


def refine_with_history(
    points: PackedPoints, texels: Texels, start: Pose, settings: DescentSettings
) -> tuple[Refined, list[Iterate]]:
    """Return the result of `refine`, and its iterates except those that line search or damping rejected."""
    tried: list[tuple[int, Iterate]] = []

    def watch(part: int, pose: Pose, loss: float) -> None:
        tried.append((part, Iterate(len(tried), pose, loss)))

    refined = refine(points, make_sampling_loss(texels), start, settings, watch)
    history = []
    least: dict[int, float] = {}  # by the descent's part
    for part, iterate in tried:
        if settings.solver == "adam" or iterate.loss <= least.get(part, np.inf):
            history.append(iterate)
        least[part] = min(iterate.loss, least.get(part, np.inf))
    return refined, [*history, Iterate(len(tried), refined.pose, refined.loss)]


def frames_of(
    points: PackedPoints, panorama: Panorama, history: Sequence[Iterate], width: int, workers: Workers
) -> list[Bytes]:
    """Draw an image for each pose, with iteration and loss on top; the last one is repeated."""
    at_start = visible_indices(points, history[0].pose.center_world)
    at_end = visible_indices(points, history[-1].pose.center_world)
    surfels = make_surfels(points.take(np.union1d(at_start, at_end)).subsample(MAX_SURFELS), workers)
    photo = resize_rgb(panorama, width)
    chosen = np.unique(np.linspace(0, len(history) - 1, min(MAX_FRAMES, len(history))).astype(int))

    def frame(k: int) -> Bytes:
        view = render_surfels(surfels, history[k].pose, width, Workers(1))
        bar = np.zeros((TEXT_HEIGHT, width, 3), np.uint8)
        text = f"iteration {history[k].iteration}   loss {history[k].loss:.4f}"
        cv2.putText(bar, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        return np.concatenate([bar, checkerboard(photo, fill_holes(view.rgb, view.is_seen))])

    frames = list(workers.map(frame, chosen.tolist(), "frames"))
    return [*frames, *[frames[-1]] * NUM_LAST]


def encode_gif(frames: Sequence[Bytes]) -> bytes:
    """Encode frames as an animated GIF."""
    file = BytesIO()
    first, *others = map(PIL.Image.fromarray, frames)
    duration = 1000 // FRAMES_PER_S
    first.save(file, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    return file.getvalue()
