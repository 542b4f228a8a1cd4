"""Photos of other cameras than spheres, from the file to the pose."""

import json
import os
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import rooms
from batches import command_of
from camera_room import SEED, place, scan
from cameras import four_sides
from pictures import encoded, write
from PIL import Image
from PIL.ExifTags import IFD, Base

from piccolo.api.result_files import read_results
from piccolo.cli.localize import main
from piccolo.geometry.pose import Pose, exp_so3, pose_errors
from piccolo.judge.result import Result
from piccolo.photo.camera import Mount
from piccolo.photo.camera.calibration import document_of, read_rig
from piccolo.photo.camera.model import Camera, pinhole
from piccolo.photo.panorama import read_panorama
from piccolo.photo.photo import Photo
from piccolo.system.jobs.threads import Workers
from research.synthetic.world import photograph, picture_of_all, render_picture

TIER = "scene"

BACK = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
FISHEYE = Camera("OPENCV_FISHEYE", 256, 256, (75.0, 75.0, 128.0, 128.0, 0.01, -0.003, 0.0, 0.0), 95.0)
PHONE = pinhole(320, 240, 260.0)
DUAL = (Mount(FISHEYE), Mount(FISHEYE, BACK, offset=(256, 0)))


def cut(full, mount):
    """The picture of a camera (H, W, 3), cut from a panorama of the same place."""
    camera = mount.camera
    width = full.shape[1]
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = camera.rays(np.stack([u, v], axis=-1))[0] @ mount.rotation
    x = width * (0.5 - np.arctan2(rays[..., 1], rays[..., 0]) / (2 * np.pi))
    y = width * (0.25 - np.arcsin(rays[..., 2]) / (2 * np.pi))
    around = np.concatenate([full[:, -4:], full, full[:, :4]], axis=1)
    return cv2.remap(around, np.float32(x + 3.5), np.float32(y - 0.5), cv2.INTER_LINEAR)


def test_a_rig_of_four_photos_equals_the_sphere_that_they_were_cut_from(tmp_path):
    this, pose = place(0)
    full = photograph(this, pose, 1024, Workers(2))
    folder = tmp_path / "instant"
    folder.mkdir()
    camera = pinhole(320, 320, 160.0)
    mounts = tuple(m.with_camera(camera) for m in four_sides())
    for mount in mounts:
        write(folder / mount.image, encoded(cut(full, mount), ".png"))
    rig = write(tmp_path / "rig.json", json.dumps(document_of(mounts)).encode())
    sphere = scan().localize(write(tmp_path / "full.png", encoded(full, ".png")), gravity="known")
    result = scan().localize(Photo(folder, rig=rig), gravity="known")
    rooms.assert_near(result.best_pose, sphere.best_pose, 0.002, 0.1)
    assert result.cameras == mounts
    assert Result.from_json(result.to_json()).cameras == mounts
    assert sphere.cameras == ()
    assert json.loads(sphere.to_json())["camera"] is None


def test_a_dual_fisheye_is_localized(tmp_path):
    this, pose = place()
    rgb = picture_of_all(DUAL, this, pose, Workers(2))
    calibration = write(tmp_path / "dual.json", json.dumps(document_of(DUAL)).encode())
    photo = write(tmp_path / "a.png", encoded(rgb, ".png"))
    result = scan().localize(Photo(photo, camera=calibration), gravity="unknown")
    rooms.assert_near(result.best_pose, pose, 0.01, 0.2)
    assert json.loads(result.to_json())["camera"]["cameras"][1]["offset"] == [256, 0]


def test_a_tilted_wide_photo_is_found_by_its_gravity(tmp_path):
    """Pitched up by 20 and rolled by 15 degrees: its own axes say where down is."""
    this, upright = place()
    R_tilt = exp_so3(np.radians([15.0, 0.0, 0.0])) @ exp_so3(np.radians([0.0, 20.0, 0.0]))
    pose = Pose(R_tilt @ upright.R_cam_from_world, upright.center_world)
    camera = Camera("SIMPLE_FISHEYE", 400, 300, (115.0, 200.0, 150.0))
    rgb = render_picture(Mount(camera), this, pose, Workers(2))
    down = tuple((pose.R_cam_from_world @ [0.0, 0.0, -9.81]).tolist())
    fov_deg = float(np.degrees(400 / 115.0))
    photo = Photo(rgb, fov_deg=fov_deg, projection="fisheye", gravity_vector=down)
    result = scan().localize(photo, gravity="known")
    rooms.assert_near(result.best_pose, pose, 0.02, 0.5)
    (mount,) = result.cameras
    assert mount.camera.params == pytest.approx(camera.params, rel=0.01)  # its focal length is fitted


@pytest.mark.process
def test_another_blas_changes_no_pose(tmp_path):
    """OpenBLAS multiplies matrices otherwise for processors without AVX."""
    this, pose = place()
    photo = write(tmp_path / "a.png", encoded(render_picture(Mount(PHONE), this, pose, Workers(2)), ".png"))
    words = ["--cloud", rooms.map_path(SEED), "--pano", photo, "--focal", PHONE.focal[0], "--quiet"]
    found = []
    for core in ("Haswell", "Prescott"):
        surroundings = {**os.environ, "OPENBLAS_CORETYPE": core}
        run = subprocess.run(
            command_of("localize.py", *words), env=surroundings, capture_output=True, text=True, check=False
        )
        found.append(Result.from_json(run.stdout).best_pose)
    np.testing.assert_allclose(found[0].center_world, found[1].center_world, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found[0].R_cam_from_world, found[1].R_cam_from_world, rtol=0, atol=1e-7)


def test_spheres_masks_of_each_picture_of_a_rig_count_together(tmp_path):
    mounts = tuple(m.with_camera(pinhole(160, 160, 80.0)) for m in four_sides())
    rig = read_rig(write(tmp_path / "rig.json", json.dumps(document_of(mounts)).encode()))
    folder, masks = tmp_path / "instant", tmp_path / "masks"
    for name in (folder, masks):
        name.mkdir()
    for k, mount in enumerate(mounts):
        write(folder / mount.image, encoded(np.full((160, 160, 3), 128, np.uint8), ".png"))
        mask = np.zeros((128, 256), np.uint8)
        mask[60:68, 40 * k : 40 * k + 20] = 255
        write(masks / f"{Path(mount.image).stem}.png", encoded(mask, ".png"))
    is_valid = read_panorama(Photo(folder, rig=rig)).is_valid
    seen = read_panorama(Photo(folder, rig=rig, mask=masks)).is_valid
    white = sum(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in masks.iterdir())
    is_masked = cv2.resize(white, is_valid.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    assert is_masked.sum() > 400
    assert not seen[is_masked].any()
    assert seen[~is_masked].sum() > 0.95 * is_valid[~is_masked].sum()


def test_rigs_and_phone_photos_on_the_command_line(tmp_path, capsys):
    """A folder of instants, and a photo with nothing but EXIF; each line names its camera."""
    cloud = ["--cloud", str(rooms.map_path(SEED)), "--gravity", "known"]
    this, pose = place()
    mounts = tuple(m.with_camera(pinhole(200, 200, 100.0)) for m in four_sides())
    rig = write(tmp_path / "rig.json", json.dumps(document_of(mounts)).encode())
    for name in ("1", "2"):
        instant = tmp_path / "walk" / name
        instant.mkdir(parents=True)
        for mount in mounts:
            write(instant / mount.image, encoded(render_picture(mount, this, pose, Workers(2)), ".png"))
    (instant / mount.image).write_bytes(b"no picture")
    main([*cloud, "--pano", str(tmp_path / "walk"), "--rig", str(rig), "--out", str(tmp_path / "out.jsonl")])
    results = read_results([tmp_path / "out.jsonl"])
    assert [Path(result.pano).name for result in results] == ["1", "2"]
    assert [result.status for result in results] == ["localized", "unreadable"]
    assert results[0].cameras == mounts
    assert pose_errors(results[0].pose, pose)[0] < 0.02
    capsys.readouterr()
    wide = render_picture(Mount(pinhole(320, 240, 100.0)), this, pose, Workers(2))
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = 11  # 400 px diagonal: 101.7 px
    Image.fromarray(wide).save(tmp_path / "phone.jpg", exif=exif, quality=95)
    main([*cloud, "--pano", str(tmp_path / "phone.jpg")])
    out, err = capsys.readouterr()
    assert json.loads(out)["camera"]["model"] == "SIMPLE_PINHOLE"
    lines = [line for line in err.splitlines() if "compiling kernels" not in line]
    first, *_, last = lines  # a warning stands below the line of its photo
    assert first.startswith(f"{tmp_path / 'phone.jpg'}: localized at")
    assert last.startswith(
        "  warning: read as a pinhole photo 115.1 deg wide, focal length 102 px from EXIF's 35 mm"
    )
    assert main([*cloud, "--pano", str(tmp_path / "phone.jpg"), "--camera", str(rig)]) == 2
    assert "give it as --rig" in capsys.readouterr().err


def test_a_folder_has_a_calibration_for_each_photo(tmp_path):
    photos = tmp_path / "photos"
    cameras = tmp_path / "cameras"
    photos.mkdir()
    cameras.mkdir()
    rgb = render_picture(Mount(pinhole(240, 180, 75.0)), *place(), Workers(2))
    for name in ("a", "b", "c"):
        write(photos / f"{name}.jpg", encoded(rgb, ".jpg"))
    write(cameras / "a.camera.json", json.dumps(document_of((Mount(pinhole(240, 180, 75.0)),))).encode())
    write(cameras / "b.json", json.dumps(document_of((Mount(pinhole(240, 180, 75.5)),))).encode())
    first, second, third = (Photo(path, camera=cameras) for path in sorted(photos.iterdir()))
    assert [read_panorama(one).cameras[0].camera.focal[0] for one in (first, second)] == [75.0, 75.5]
    found, lacking = scan().localize_many([first, third], gravity="known")
    assert (found.status, found.focal_length.given_px) == ("localized", 75.0)
    assert found.settings["panorama"]["camera"] == str(cameras)
    assert lacking.status == "unreadable"
    assert f"found no calibration of it in {cameras}, wanted c.camera.json or c.json" in lacking.error
