"""A made-up room as datasets hold it: panoramas by their own formulas, and whether converted poses fit them.

Nothing here takes a pose or a pixel from the code under test: the rays of a panorama are written down again.
"""

import json

import numpy as np
import rooms
from pictures import encoded
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Pose
from piccolo.optimize.sampling_loss import sampling_loss
from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.texels import pack_texels
from piccolo.system.jobs.threads import Workers
from piccolo.views.zbuffer import visible_points
from research.datasets import convert_dataset
from research.scene import read_scene
from research.synthetic.raycast import cast_rays

SEED = 5
WIDTH = 256
OPTICAL, OPENGL, FORWARD_LEFT_UP = "optical", "opengl", "forward left up"


def rays(axes, width=WIDTH):
    """Camera directions (H, W, 3) of a panorama's pixels: longitude to the right of the middle, latitude."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(width // 2) + 0.5) / (width // 2)) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    right = np.sin(longitude) * np.cos(latitude)
    up = np.sin(latitude)
    forward = np.cos(longitude) * np.cos(latitude)
    of = {OPTICAL: (right, -up, forward), OPENGL: (right, up, -forward)}
    of[FORWARD_LEFT_UP] = (forward, -right, up)
    return np.stack(of[axes], axis=-1)


def points_and_colors(num_points=20_000):
    """The room's scan in its own coordinates."""
    cloud = rooms.room(SEED)[1]
    chosen = np.random.default_rng(1).choice(len(cloud.points), num_points, replace=False)
    return (cloud.points + cloud.origin_world)[chosen], cloud.colors[chosen]


def cameras(count=2):
    """Rotations R_world_from_cam turned anyhow, and free positions; any axes may be meant."""
    centers = [rooms.query(SEED, "clean", k).pose.center_world for k in range(count)]
    return list(zip(Rotation.random(count, random_state=7).as_matrix(), centers, strict=True))


def look(directions, center):
    """Colours (..., 3) and hit points (..., 3) along world directions from a position."""
    (room,) = rooms.room(SEED)[0].rooms
    ranges, rgb, _ = cast_rays(room, np.asarray(center), directions.reshape(-1, 3), Workers(2), "look")
    points = center + ranges[:, None] * directions.reshape(-1, 3)
    return np.round(rgb * 255).astype(np.uint8).reshape(directions.shape), points.reshape(directions.shape)


def picture(R_world_from_cam, center, axes):
    """A panorama (H, W, 3) by a camera with these axes, and the points that its pixels show."""
    return look(rays(axes) @ R_world_from_cam.T, center)


def write_picture(path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded(rgb, path.suffix))


def write_text_cloud(path, points, colors, decimals=3):
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.hstack([points, colors]), fmt=[f"%.{decimals}f"] * 3 + ["%d"] * 3)


def run(capsys, dataset, source, out, *options):
    """Exit code, a dictionary a scene and stderr of the tool."""
    arguments = [dataset, "--from", source, "--out", out, "--quiet", *options]
    code = convert_dataset.main([str(a) for a in arguments])
    stdout, stderr = capsys.readouterr()
    return code, [json.loads(line) for line in stdout.splitlines()], stderr


def assert_refused(message, capsys, dataset, source, out, *options):
    """The tool writes no scene, and says why."""
    code, lines, err = run(capsys, dataset, source, out, *options)
    assert (code, lines) == (3, [])
    assert message in err


def vertices(path):
    """The vertices of a PLY."""
    return PlyData.read(path)["vertex"].data


def assert_fits(folder, max_loss=0.13):
    """The points have the colours of the panoramas at their poses, and not with the transposed rotation."""
    scene = read_scene(folder)
    data = vertices(scene.cloud)
    points = np.stack([data["x"], data["y"], data["z"]], axis=1)
    colors = np.stack([data["red"], data["green"], data["blue"]], axis=1)
    origin = points.mean(axis=0)
    packed = pack_points((points - origin).astype(np.float32), colors)
    assert scene.queries
    for query in scene.queries:
        panorama = read_panorama(query.image)
        texels = pack_texels(panorama.rgb, panorama.is_valid)
        R = query.pose.R_cam_from_world
        center = query.pose.center_world - origin
        seen = visible_points(packed, center)
        loss, wrong = (sampling_loss(seen, texels, Pose(turn, center)) for turn in (R, R.T))
        assert loss < max_loss
        assert loss < 0.5 * wrong
    return scene
