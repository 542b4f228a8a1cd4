"""Photos and panoramas of places outdoors, of the same surfaces as the scans but not made of these."""

import numpy as np

from piccolo.evidence.focal_length import NOT_CALIBRATED
from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.photo.camera import Camera, Mount
from piccolo.photo.camera.model import camera_of_fov
from piccolo.system.arrays import Array
from piccolo.system.jobs.threads import Workers

from . import world as worlds
from .outdoor_scans import draw_position
from .outdoors import Place
from .world import Photo, Query

FOVS_DEG = (60.0, 90.0)
HEIGHTS = (1.3, 1.9)  # of a camera [m]
PITCH_DEG = (-3.0, 15.0)
ROLL_DEG = 3.0
AROUND_FOCUS = 0.45  # [rad] to both sides
ALONG_STREET = 0.9


def draw_heading(place: Place, position: Array, rng: np.random.Generator) -> float:
    """Draw where people look from a position (3,) [rad]: at the focus, along a street, anywhere."""
    if place.focus is not None:
        x, y = place.focus - position[:2]
        return float(np.arctan2(y, x) + rng.uniform(-AROUND_FOCUS, AROUND_FOCUS))
    if place.kind == "street":
        return float(rng.choice([0.0, np.pi]) + rng.uniform(-ALONG_STREET, ALONG_STREET))
    return float(rng.uniform(0.0, 2.0 * np.pi))


def draw_lens(ideal: Camera, rng: np.random.Generator) -> Camera:
    """Draw the camera that is taken for an ideal one if nothing but its focal length is known.

    Without, what is allowed for would be in no photo, and stated deviations of rotations far too wide.
    """
    aspect, right, down, radial = np.array(NOT_CALIBRATED) * rng.normal(size=len(NOT_CALIBRATED))
    focal = ideal.focal[0]
    x, y = ideal.center
    fy = focal * np.exp(aspect)
    lens = (focal, fy, x + right * focal, y + down * fy, radial, 0.0, 0.0, 0.0)
    return Camera("OPENCV", ideal.width, ideal.height, tuple(map(float, lens)))


def take_photo(place: Place, index: int, workers: Workers) -> Photo:
    """Take photo number `index` of a place, as processed by some phone."""
    rng = np.random.default_rng([place.seed, 62, index])
    position = draw_position(place, rng, HEIGHTS)
    pitch, roll = np.radians([rng.uniform(*PITCH_DEG), rng.uniform(-ROLL_DEG, ROLL_DEG)])
    R_cam_from_level = exp_so3(np.array([roll, 0.0, 0.0])) @ exp_so3(np.array([0.0, pitch, 0.0]))
    R_cam_from_world = R_cam_from_level @ yaw_rotation(draw_heading(place, position, rng))
    camera = camera_of_fov("pinhole", rng.uniform(*FOVS_DEG), *worlds.PHOTO_SIZE)
    pose = Pose(R_cam_from_world, position)
    lens = draw_lens(camera, np.random.default_rng([place.seed, 65, index]))
    rgb = worlds.render_picture(Mount(lens), place.room, pose, workers)
    return Photo(worlds.change_sensor(rgb, rng, rng), pose, camera.focal[0])


def take_panorama(place: Place, index: int, width: int, workers: Workers) -> Query:
    """Take panorama number `index` of a place, upright, as processed by some camera."""
    rng = np.random.default_rng([place.seed, 63, index])
    pose = Pose(yaw_rotation(rng.uniform(0.0, 2.0 * np.pi)), draw_position(place, rng, HEIGHTS))
    rgb = worlds.photograph(place.room, pose, width, workers)
    return Query(worlds.change_sensor(rgb, rng, rng), pose, place.kind)
