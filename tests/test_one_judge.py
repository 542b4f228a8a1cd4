"""Photos that help each other never overrule what the judge has ruled out: each runs the real thing."""

import json

import numpy as np
import rooms
from pictures import encoded, write
from test_focal_length import TRUE, _photo
from test_localize_cameras import SEED, place, scan
from test_walk import _walk_through

import piccolo
from piccolo.camera import Mount
from piccolo.camera.calibration import document_of
from piccolo.camera.model import pinhole
from piccolo.cli.localize import main
from piccolo.cloud.writers import vertex_rows, write_ply
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.jobs.threads import Workers
from piccolo.result import read_results
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
    world, cloud = rooms.room(3)
    poses = _walk_through(world)[:4]
    frames = [photograph(world.rooms[0], p, rooms.WIDTH, Workers(2)) for p in poses]
    points_world = cloud.points.astype(float) + cloud.origin_world
    opened = piccolo.open_scan(piccolo.Cloud(points_world, colors=cloud.colors), num_threads=2)
    prior = piccolo.Prior(near=tuple(poses[0].center_world), radius=0.4)
    times = [0.5 * k for k in range(len(frames))]
    results = opened.localize_walk(frames, times, prior=prior, gravity="known")
    for result, pose in zip(results, poses, strict=True):
        distance = float(np.linalg.norm(pose.center_world - poses[0].center_world))
        if distance > 0.6:
            assert result.status != "localized"
            assert not result.best_pose or any("from the place given" in w for w in result.warnings)
        elif distance < 0.4:
            assert result.status == "localized"


def test_a_doubtful_photo_is_sure_beside_another(tmp_path):
    """A whole second look: a narrow photo of what a wide one shows."""
    room, pose = place(1)
    near = Pose(yaw_rotation(0.2) @ pose.R_cam_from_world, pose.center_world + np.array([0.15, 0.1, 0.05]))
    photos, cameras = tmp_path / "photos", tmp_path / "cameras"
    photos.mkdir()
    cameras.mkdir()
    for name, focal, at in (("narrow", 360.0, near), ("wide", 200.0, pose)):
        camera = Mount(pinhole(640, 480, focal))
        write(photos / f"{name}.png", encoded(render_picture(camera, room, at, Workers(2)), ".png"))
        write(cameras / f"{name}.camera.json", json.dumps(document_of((camera,))).encode())
    cloud = rooms.room(SEED)[1]
    write_ply(tmp_path / "scan.ply", vertex_rows(cloud.points + cloud.origin_world, cloud.colors))
    words = ["--cloud", str(tmp_path / "scan.ply"), "--camera", str(cameras), "--quiet", "--threads", "2"]
    alone = tmp_path / "alone.jsonl"
    main([*words, "--pano", str(photos / "narrow.png"), "--out", str(alone)])
    both = tmp_path / "both.jsonl"
    main([*words, "--pano", str(photos), "--out", str(both)])
    (before,), (narrow, wide) = read_results([alone]), read_results([both])
    assert before.status != "localized"
    assert wide.status == "localized"
    assert wide.beside is None
    assert narrow.beside.photos == (str(photos / "wide.png"),)
    assert narrow.status == "localized"
    assert before.confidence < narrow.confidence <= wide.confidence
    assert narrow.pose.distance(near) < 0.05
