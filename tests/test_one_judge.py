"""Photos that help each other never overrule what the judge has ruled out: each runs the real thing."""

import numpy as np
import rooms
from test_focal_length import TRUE, _photo
from test_localize_cameras import place, scan
from test_walk import _walk_through

import piccolo
from piccolo.camera import Mount
from piccolo.camera.model import pinhole
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.jobs.threads import Workers
from research.synthetic.world import photograph, render_picture


def test_a_bundle_of_one_keeps_what_its_photo_rules_out():
    """A focal length that the picture contradicts."""
    rgb, pose = _photo(pinhole(640, 480, TRUE))
    photo = piccolo.Photo(rgb, focal_px=0.89 * TRUE)
    alone = scan().localize(photo, gravity="known")
    (together,) = scan().localize_bundle([photo], [pose], gravity="known")
    for result in (alone, together):
        assert result.status == "not_localized"
        assert any("the picture has a focal length of" in warning for warning in result.warnings)


def test_photos_of_one_wrong_focal_length_are_not_sure_together():
    room, pose = place(1)
    camera = Mount(pinhole(640, 480, TRUE))
    poses = [pose]
    for turn in (0.5, 1.0):
        center = pose.center_world + np.array([0.05, 0.03, 0.0])
        poses.append(Pose(yaw_rotation(turn) @ pose.R_cam_from_world, center))
    photos = [render_picture(camera, room, p, Workers(2)) for p in poses]
    given = [piccolo.Photo(photo, focal_px=0.89 * TRUE) for photo in photos]
    results = scan().localize_bundle(given, poses, gravity="known")
    for result, true in zip(results, poses, strict=True):
        if result.status == "localized":
            assert result.pose.distance(true) < 0.05
        else:
            assert result.confidence < 0.9


def test_a_frame_that_contradicts_the_prior_says_so_in_a_walk():
    world = rooms.room(3)[0]
    poses = _walk_through(world)[:4]
    frames = [photograph(world.rooms[0], p, rooms.WIDTH, Workers(2)) for p in poses]
    prior = piccolo.Prior(near=tuple(poses[0].center_world), radius=0.4)
    times = [0.5 * k for k in range(len(frames))]
    results = rooms.scan(3).localize_walk(frames, times, prior=prior, gravity="known")
    for result, pose in zip(results, poses, strict=True):
        distance = float(np.linalg.norm(pose.center_world - poses[0].center_world))
        if distance > 0.6:
            assert result.status != "localized"
            assert not result.best_pose or any("from the place given" in w for w in result.warnings)
        elif distance < 0.4:
            assert result.status == "localized"
