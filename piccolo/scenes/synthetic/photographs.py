"""Pictures of a made room by any cameras, each where it sits."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...camera import Mount
from ...camera.rig import extent_of
from ...geometry.pose import Pose
from ...runtime.threads import Workers
from .raycast import cast_rays
from .room import Room

SUPERSAMPLING = 2  # rays a pixel, each way


def picture_by(mount: Mount, room: Room, pose: Pose, workers: Workers) -> NDArray[np.uint8]:
    """What a camera takes (H, W, 3) of a room with its rig at `pose`; black where it shows nothing."""
    camera, num = mount.camera, SUPERSAMPLING
    u, v = np.meshgrid(np.arange(num * camera.width) + 0.5, np.arange(num * camera.height) + 0.5)
    rays, is_seen = camera.rays(np.stack([u, v], axis=-1) / num)
    rays_world = rays[is_seen] @ mount.rotation @ pose.R_cam_from_world
    center_world = pose.center_world + pose.R_cam_from_world.T @ np.array(mount.center_cam)
    rgb = np.zeros((*is_seen.shape, 3), np.float32)
    rgb[is_seen] = cast_rays(room, center_world, rays_world, workers, "photo")[1]
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
