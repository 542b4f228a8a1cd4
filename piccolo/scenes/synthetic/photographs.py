"""Pictures of a made room by any cameras, each where it sits."""

import re
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...camera import Calibration, Mount
from ...camera.rig import extent_of
from ...errors import InputError
from ...geometry.pose import Pose
from ...jobs.threads import Workers
from .raycast import cast_rays
from .room import Room
from .world import World, other_light, pose_of_query

SUPERSAMPLING = 2  # rays a pixel, each way
MAX_SIDE = 4096  # [px] of a picture
Named = list[tuple[str, NDArray[np.uint8]]]  # pictures (H, W, 3) by file name; "" of one that stands alone


def check_can_be_made(cameras: Calibration, has_labels: bool) -> None:
    """Refuse, before any work is done, cameras whose pictures can't be made, naming the option."""
    path, mounts = cameras.path, cameras.mounts
    if has_labels:
        raise InputError("--labels: not with --camera")
    if cameras.is_choice and len(mounts) > 1:
        raise InputError(f"--camera: found {len(mounts)} cameras in {path}, wanted one, or those of a rig")
    if not cameras.has_sizes or max(extent_of(mounts)) > MAX_SIDE:
        raise InputError(f"--camera: found pictures of no size in {path}, or over {MAX_SIDE} px")
    names = [mount.image for mount in mounts if mount.image is not None]
    if any(re.search(r"[*?|\[/]", name) or not name.endswith((".jpg", ".png")) for name in names):
        raise InputError(f"--camera: found images {names} in {path}, wanted names of .jpg or .png files")


def make_photos(
    world: World, number: tuple[str, int], cameras: Calibration, workers: Workers
) -> tuple[Named, Pose]:
    """The pictures of the query of a variant and index by these cameras, and the pose of the whole."""
    variant, index = number
    room, pose, rng = pose_of_query(world, index, variant)
    if cameras.is_rig:
        pictures = [(m.image or "", picture_by(m, room, pose, workers)) for m in cameras.mounts]
    else:
        pictures = [("", picture_of_all(cameras.mounts, room, pose, workers))]
    if variant == "photo":
        pictures = [(name, other_light(rgb, rng)) for name, rgb in pictures]
    return pictures, pose


def picture_by(mount: Mount, room: Room, pose: Pose, workers: Workers) -> NDArray[np.uint8]:
    """What a camera takes (H, W, 3) of a room with its rig at `pose`; black where it shows nothing."""
    camera, num = mount.camera, SUPERSAMPLING
    u, v = np.meshgrid(np.arange(num * camera.width) + 0.5, np.arange(num * camera.height) + 0.5)
    rays, is_seen = camera.rays(np.stack([u, v], axis=-1) / num)
    own = mount.pose(pose)
    rgb = np.zeros((*is_seen.shape, 3), np.float32)
    rays_world = rays[is_seen] @ own.R_cam_from_world
    rgb[is_seen] = cast_rays(room, own.center_world, rays_world, workers, "photo")[1]
    small = cv2.resize(rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(np.round(small * 255.0), np.uint8)


def picture_of_all(mounts: Sequence[Mount], room: Room, pose: Pose, workers: Workers) -> NDArray[np.uint8]:
    """The one picture in which cameras have their parts, such as a dual fisheye."""
    width, height = extent_of(mounts)
    rgb = np.zeros((height, width, 3), np.uint8)
    for mount in mounts:
        (left, top), camera = mount.offset, mount.camera
        rgb[top : top + camera.height, left : left + camera.width] = picture_by(mount, room, pose, workers)
    return rgb
