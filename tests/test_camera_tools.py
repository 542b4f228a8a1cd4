"""The tools around photos of other cameras: made rooms, evaluation, exports, renderings, overlays."""

import json

import cv2
import numpy as np
import pycolmap
import pytest
from pictures import write
from rooms import write_room

from piccolo.api.result_files import read_results
from piccolo.apps import render_pose
from piccolo.apps.export import export_poses
from piccolo.cli import localize
from piccolo.geometry.pose import exp_so3
from piccolo.photo.camera import Camera, Mount
from piccolo.photo.camera.calibration import document_of
from piccolo.photo.camera.model import pinhole
from piccolo.system.jobs.threads import Workers
from piccolo.views.pictures import cut, sphere_width_for
from research.evaluation import evaluate
from research.scene import read_scene
from research.synthetic import make_room
from research.synthetic.world import make_world, photograph, pose_of_query, render_picture

TIER = "scene"

WIDE = Camera("OPENCV", 480, 400, (150.0, 152.0, 245.0, 198.0, -0.02, 0.001, 1e-3, -1e-3))
TURN = tuple(map(tuple, exp_so3(np.radians([0.0, 0.0, 90.0])).tolist()))
RIG = (Mount(pinhole(240, 240, 110.0), image="a.jpg"), Mount(pinhole(240, 240, 110.0), TURN, image="b.png"))


def calibration(path, mounts):
    return write(path, json.dumps(document_of(mounts)).encode())


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A room with a photo by a wide camera, and the calibration."""
    folder = tmp_path_factory.mktemp("photos")
    camera = calibration(folder / "camera.json", (Mount(WIDE),))
    return write_room(folder, f"--seed 1 --points 60000 --panoramas 1 --camera {camera}")


def test_the_same_pose_is_photographed_as_a_sphere_and_by_a_camera():
    world = make_world(3, np.array([4.0, 4.0, 2.5]))
    room, pose, _ = pose_of_query(world, 0, "tilt")
    full = photograph(room, pose, 1536, Workers(2))
    mount = Mount(WIDE, TURN)
    drawn = render_picture(mount, room, pose, Workers(2))
    difference = np.abs(cut(full, WIDE, mount.rotation).astype(int) - drawn)
    assert np.median(difference) <= 2
    assert difference.mean() < 4


def test_localize_overlay_export_and_render_show_the_photo_s_own_field(photos, tmp_path, capsys):
    image, camera = photos / "images/clean_0.jpg", photos / "camera.json"
    out, overlay = tmp_path / "pose.jsonl", tmp_path / "overlay.png"
    cloud = ["--cloud", str(photos / "cloud.ply")]
    command = [*cloud, "--pano", str(image), "--camera", str(camera), "--gravity", "known", "--cache", "none"]
    localize.main([*command, "--out", str(out), "--overlay", str(overlay)])
    (result,) = read_results([out])
    (found,) = result.cameras  # the focal length is fitted, within what a calibration is good to
    assert found.camera.focal == pytest.approx(WIDE.focal, rel=0.005)
    assert found.camera.params[2:] == WIDE.params[2:]
    photo = cv2.imread(str(image)).astype(float)

    shown, seen, _ = np.split(cv2.imread(str(overlay)).astype(float), 3)
    assert shown.shape == (853, 1024, 3)
    large = cv2.resize(photo, (1024, 853), interpolation=cv2.INTER_LINEAR)
    assert np.abs(shown - large)[10:-10, 10:-10].mean() < 8
    assert np.corrcoef(seen.ravel(), large.ravel())[0, 1] > 0.9

    drawn, depth = tmp_path / "seen.png", tmp_path / "depth.npy"
    words = ["--result", str(out), "--out", str(drawn), "--depth", str(depth), "--width", "480"]
    assert render_pose.main([*cloud, *words]) == 0
    picture = cv2.imread(str(drawn)).astype(float)
    assert picture.shape == photo.shape
    assert np.corrcoef(picture.ravel(), photo.ravel())[0, 1] > 0.9
    ranges = np.load(depth)
    assert ranges.shape == photo.shape[:2]
    assert 0.3 < np.median(ranges) < 6.0

    model = tmp_path / "model"
    assert export_poses.main(["--results", str(out), "--format", "colmap", "--out", str(model), "--all"]) == 0
    (theirs,) = pycolmap.Reconstruction(str(model)).images.values()
    rays, _ = found.camera.rays(np.array([[100.0, 300.0]]))
    point = result.best_pose.center_world + 3.0 * rays[0] @ result.best_pose.R_cam_from_world
    np.testing.assert_allclose(theirs.project_point(point), [100.0, 300.0], atol=1e-6)


def test_a_camera_s_picture_of_any_pose_is_drawn(photos, tmp_path):
    words = ["--cloud", str(photos / "cloud.ply"), "--at", "2", "2", "1.5", "--width", "320"]
    camera = calibration(tmp_path / "small.json", (Mount(pinhole(64, 48, 40.0)),))
    out = tmp_path / "east.png"
    assert render_pose.main([*words, "--camera", str(camera), "--out", str(out)]) == 0
    assert cv2.imread(str(out)).shape == (240, 320, 3)
    two = calibration(tmp_path / "two.json", (Mount(WIDE), Mount(WIDE, offset=(480, 0))))
    assert render_pose.main([*words, "--camera", str(two), "--out", str(out)]) == 3


def test_the_sphere_is_as_fine_as_the_picture_cut_from_it():
    assert sphere_width_for(pinhole(640, 480, 100.0)) == 630
    assert sphere_width_for(pinhole(640, 480, 9000.0)) == 8192


def test_a_made_rig_is_a_folder_an_instant_which_evaluate_takes_and_resumes(tmp_path, capsys):
    camera = calibration(tmp_path / "rig.json", RIG)
    folder = write_room(tmp_path / "room", f"--seed 3 --points 60000 --panoramas 1 --camera {camera}")
    (query,) = read_scene(folder).queries
    assert query.cameras == RIG
    assert sorted(path.name for path in query.image.iterdir()) == ["a.jpg", "b.png"]
    assert query.calibration.is_instant(query.image)
    run = tmp_path / "run.jsonl"
    options = ["--scenes", str(folder), "--out", str(run), "--gravity", "known", "--cache", str(tmp_path)]
    assert evaluate.main(options) == 0
    lines = run.read_bytes()
    row = json.loads(lines)
    assert len(row["result"]["camera"]["cameras"]) == 2
    assert row["position_error"] < 0.02
    assert evaluate.main(options) == 0
    assert run.read_bytes() == lines


@pytest.mark.parametrize(
    ("mounts", "more", "message"),
    [
        (RIG, ["--labels"], "--labels: not with --camera"),
        ((Mount(pinhole(9000, 100, 50.0)),), [], "--camera: found pictures of no size in .* or over 4096 px"),
        ((Mount(WIDE, image="*.jpg"),), [], "--camera: found images"),
        ((Mount(WIDE, image="../a.jpg"),), [], "--camera: found images"),
    ],
)
def test_cameras_that_can_not_be_made_are_refused(tmp_path, capsys, mounts, more, message):
    camera = calibration(tmp_path / "camera.json", mounts)
    assert make_room.main(["--out", str(tmp_path / "room"), "--camera", str(camera), *more]) == 2
    assert message.split(" .* ")[0] in capsys.readouterr().err
    assert not (tmp_path / "room").exists()
