import json
import struct

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings, strategies as st
from refusals import assert_refused, mutated, read_or_refused

from piccolo.geometry.pose import OPTICAL_FROM_CAM, exp_so3, quaternion_wxyz
from piccolo.photo.camera.calibration import Mount, document_of, read_calibration, read_mounts, read_rig
from piccolo.photo.camera.model import MODELS, Camera
from piccolo.photo.camera.resampling import CameraView, make_sphere, sphere_width
from piccolo.system.errors import InputError

TURN = exp_so3(np.array([0.2, -0.4, 1.1]))
BACK = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))


def write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def rows(R):
    return tuple(map(tuple, R.tolist()))


def test_cameras_txt_as_colmap_writes_it(tmp_path):
    model = pycolmap.Reconstruction()
    params = [800.0, 810.0, 321.5, 240.25, 0.1, -0.02, 0.001, 0.002]
    model.add_camera(pycolmap.Camera(camera_id=1, model="OPENCV", width=640, height=480, params=params))
    more = {"model": "SIMPLE_RADIAL", "width": 1000, "height": 500, "params": [700.0, 500.0, 250.0, 0.05]}
    model.add_camera(pycolmap.Camera(camera_id=2, **more))
    model.write_text(str(tmp_path))
    found = read_calibration(tmp_path / "cameras.txt")
    assert found.for_picture(640, 480) == (Mount(Camera("OPENCV", 640, 480, tuple(params))),)
    assert found.for_picture(1000, 500)[0].camera.model == "SIMPLE_RADIAL"
    with pytest.raises(InputError, match="found 2 cameras, 0 of them for 320 x 240, wanted one; sizes there"):
        found.for_picture(320, 240)


def test_one_camera_is_scaled_to_another_size_of_its_shape(tmp_path):
    found = read_calibration(write(tmp_path / "c.txt", "# comment\n1 PINHOLE 640 480 600 610 320 240\n"))
    assert found.for_picture(320, 240)[0].camera.params == (300.0, 305.0, 160.0, 120.0)
    with pytest.raises(InputError, match=r"c.txt: found a picture of 640 x 360 and a calibration for 640"):
        found.for_picture(640, 360)


OPENSFM = {
    "perspective": ({"focal": 0.8, "k1": 0.1, "k2": -0.02}, "RADIAL", (800, 500, 400, 0.1, -0.02)),
    "brown": (
        {"focal_x": 0.8, "focal_y": 0.9, "c_x": 0.01, "c_y": -0.02}
        | {"k1": 1, "k2": 2, "k3": 3, "p1": 4, "p2": 5},
        "FULL_OPENCV",
        (800, 900, 510, 380, 1, 2, 4, 5, 3, 0, 0, 0),
    ),
    "fisheye": ({"focal": 0.3, "k1": 0.1, "k2": 0.2}, "RADIAL_FISHEYE", (300, 500, 400, 0.1, 0.2)),
    "fisheye_opencv": (
        {"focal_x": 0.3, "focal_y": 0.31, "c_x": 0.01, "c_y": 0.02, "k1": 1, "k2": 2, "k3": 3, "k4": 4},
        "OPENCV_FISHEYE",
        (300, 310, 510, 420, 1, 2, 3, 4),
    ),
    "radial": (
        {"focal_x": 0.8, "focal_y": 0.8, "k1": 0.1, "k2": 0.2},
        "FULL_OPENCV",
        (800, 800, 500, 400, 0.1, 0.2),
    ),
    "spherical": ({}, "EQUIRECTANGULAR", (1000, 800)),
}


@pytest.mark.parametrize("projection", OPENSFM)
def test_camera_models_of_opensfm(tmp_path, projection):
    fields, model, params = OPENSFM[projection]
    entry = {"projection_type": projection, "width": 1000, "height": 800, **fields}
    (mount,) = read_calibration(write(tmp_path / "a.json", {"v2 x": entry})).for_picture(1000, 800)
    assert mount.camera.model == model
    wanted = [*params, *[0.0] * (len(mount.camera.params) - len(params))]
    np.testing.assert_allclose(mount.camera.params, wanted, rtol=1e-12)


def test_the_middle_of_opensfm_is_the_middle_of_the_picture(tmp_path):
    """Its pixels begin at the centre of the first one: (width - 1) / 2 there is width / 2 here."""
    entry = {"projection_type": "perspective", "width": 600, "height": 800, "focal": 0.9}
    (mount,) = read_calibration(write(tmp_path / "a.json", {"a": entry})).for_picture(600, 800)
    pixels, _ = mount.camera.pixels(np.array([[1.0, 0.0, 0.0], [1.0, -0.1, 0.0]]))
    np.testing.assert_allclose(pixels, [[300.0, 400.0], [372.0, 400.0]])


def test_our_own_json_comes_back(tmp_path):
    lens = Camera("OPENCV_FISHEYE", 800, 800, (250.0, 251.0, 400.0, 401.0, 0.01, 0.0, 0.0, 0.0), 95.0)
    mounts = (Mount(lens), Mount(lens, rows(TURN), (0.0, 0.01, -0.02), (800, 0)))
    for some in (mounts, mounts[:1], mounts[1:]):
        document = document_of(some)
        assert read_mounts(json.loads(json.dumps(document))) == some
        found = read_calibration(write(tmp_path / "a.json", document))
        assert found.mounts == some
        assert not found.is_choice
    assert "cameras" not in document_of(mounts[:1])
    with pytest.raises(InputError, match="found cameras in a picture of 1600 x 800, wanted 1600 x 801"):
        read_calibration(write(tmp_path / "a.json", document_of(mounts))).for_picture(1600, 801)


def test_rig_config_of_colmap(tmp_path):
    """x_cam = R x_rig + t in axes right, down, forward; its reference camera is our frame."""
    wxyz = quaternion_wxyz(TURN)
    t = np.array([0.05, -0.02, 0.01])
    cameras = [
        {"image_prefix": "rig1/a/", "ref_sensor": True},
        {
            "image_prefix": "rig1/b/",
            "cam_from_rig_rotation": wxyz.tolist(),
            "cam_from_rig_translation": t.tolist(),
        },
    ]
    lens = {"camera_model_name": "SIMPLE_PINHOLE", "camera_params": [400, 320, 240]}
    cameras = [camera | lens for camera in cameras]
    rig = read_rig(write(tmp_path / "rig.json", [{"cameras": cameras}]))
    assert rig.is_rig
    assert not rig.has_sizes
    first, second = rig.mounts
    assert first == Mount(first.camera, image=first.image)
    x_cam = np.array([0.3, 0.7, -0.2])  # a point in our axes
    theirs = TURN @ OPTICAL_FROM_CAM @ x_cam + t
    ours = second.rotation @ (x_cam - np.array(second.center_cam))
    np.testing.assert_allclose(OPTICAL_FROM_CAM @ ours, theirs, atol=1e-12)
    folder = tmp_path / "instant"
    for name in ("a", "b", "ab"):
        (folder / name).mkdir(parents=True)
        write(folder / name / "0001.jpg", "")
    assert rig.images_in(folder) == [folder / "a/0001.jpg", folder / "b/0001.jpg"]
    write(folder / "b/0002.jpg", "")
    assert not rig.is_instant(folder)


def test_files_of_a_rig_are_told_by_their_names(tmp_path):
    lens = Camera("SIMPLE_PINHOLE", 640, 480, (400.0, 320.0, 240.0))
    mounts = (Mount(lens, image="*_front.jpg"), Mount(lens, BACK, image="*_back.jpg"))
    rig = read_rig(write(tmp_path / "rig.json", document_of(mounts)))
    assert rig.mounts == mounts
    folder = tmp_path / "1"
    folder.mkdir()
    for name in ("7_front.jpg", "7_back.jpg", "notes.txt", ".hidden_back.jpg"):
        write(folder / name, "")
    assert rig.images_in(folder) == [folder / "7_front.jpg", folder / "7_back.jpg"]
    write(folder / "8_back.jpg", "")
    with pytest.raises(InputError, match=r"found 2 pictures for the camera '.*_back.jpg' of .*, wanted one"):
        rig.images_in(folder)
    assert_refused("found a rig, each camera with an image", read_calibration, tmp_path / "rig.json")
    single = write(tmp_path / "c.json", document_of((Mount(lens),)))
    assert_refused("found a camera without an image", read_rig, single)


SIZE = {"width": 64, "height": 48}
GOOD = {"format": "piccolo-camera/1", "model": "SIMPLE_PINHOLE", **SIZE, "params": [60, 32, 24]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "found no camera"),
        ("1 PINHOLE 640 480 600", "line 1: found .* as parameters of PINHOLE, wanted 4 finite"),
        ("1 PINHOLE wide 480 600", "line 1: invalid literal"),
        ("{", "JSON|Expecting"),
        ({"a": {"projection_type": "dual", "width": 9, "height": 9}}, "the projection 'dual', not one of"),
        ({"a": {"projection_type": "brown", "width": 9, "height": 9}}, "no field 'focal_x'"),
        ({**GOOD, "format": "piccolo-camera/9"}, "format 'piccolo-camera/9', not 'piccolo-camera/1'"),
        ({**GOOD, "width": 64.5}, "64.5, no whole number"),
        ({**GOOD, "colour": 1}, "a field 'colour' that is none of"),
        ({**GOOD, "R_lens_from_cam": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "found a matrix that is no rot"),
        ({**GOOD, "center_cam": [0, 0]}, r"float64 \(2,\), wanted arrays of numbers"),
        ({**GOOD, "center_cam": [0, 0, 1e30]}, "center_cam: found a position .*, wanted finite numbers"),
        ({**GOOD, "offset": [-1, 0]}, "found offset"),
        ({**GOOD, "image": 7}, "an image 7 that is no name"),
        ({**GOOD, "params": None}, "fields of another kind"),
        ({"format": "piccolo-camera/1", "cameras": []}, "found 0 cameras, wanted 1 to 64"),
    ],
)
def test_damaged_files_are_refused(tmp_path, content, message):
    assert_refused(message, read_calibration, write(tmp_path / "a.json", content))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "Expecting"),
        ([{"cameras": [{"image_prefix": "a/"}]}], "no camera_model_name or camera_params for 'a/'"),
        ([{"cameras": [{"image_prefix": "a/"}]}, {}], "found 2 rigs, wanted one"),
        ([7], "fields of another kind"),
    ],
)
def test_damaged_rigs_are_refused(tmp_path, content, message):
    assert_refused(message, read_rig, write(tmp_path / "a.json", content))


@settings(max_examples=50)
@given(data=st.data())
@pytest.mark.parametrize("name", ["cameras.txt", "ours.json", "opensfm.json", "rig.json"])
def test_mutated_files_are_read_or_refused(name, data, tmp_path_factory):
    lens = {"camera_model_name": "PINHOLE", "camera_params": [400, 400, 32, 24]}
    content = {
        "cameras.txt": "# c\n1 OPENCV 64 48 60 60 32 24 0.1 -0.02 0.001 0.002\n",
        "ours.json": json.dumps({**GOOD, "offset": [0, 0], "center_cam": [0, 0, 0.1], "max_angle_deg": 80}),
        "opensfm.json": json.dumps({"a": {"projection_type": "brown", **OPENSFM["brown"][0], **SIZE}}),
        "rig.json": json.dumps([{"cameras": [{"image_prefix": f"{k}/", **lens} for k in "ab"]}]),
    }[name]
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(mutated(data.draw, st.integers, content.encode(), 3))
    found, message = read_or_refused(read_rig if name == "rig.json" else read_calibration, path)
    assert (found is None) == bool(message)


ANY = st.one_of(st.floats(-3.0, 3.0), st.floats(-1e6, 1e6), st.just(0.0))


@settings(max_examples=50)
@given(data=st.data())
def test_any_camera_that_is_taken_can_be_resampled(data):
    """Whatever the numbers: what they can't show is not valid, and what is has a pixel."""
    model = data.draw(st.sampled_from(sorted(MODELS)))
    params = tuple(data.draw(ANY) for _ in MODELS[model][1])
    try:
        camera = Camera(model, 64, 48, params)
    except InputError:
        return
    views = [CameraView(Mount(camera), np.full((48, 64, 4), 255, np.uint8))]
    width = sphere_width([Mount(camera)]) if params[0] < 99 else 512
    rgb, is_valid = make_sphere(views, width)
    assert rgb[is_valid].min(initial=255) == 255
    pixels = np.random.default_rng(0).uniform(0.0, 1.0, (200, 2)) * (64, 48)
    rays, is_seen = camera.rays(pixels)
    back, is_in = camera.pixels(rays)
    assert np.isfinite(rays).all()
    assert np.abs(back - pixels)[is_seen & is_in].max(initial=0.0) < 1e-3


MATRIX = [60.0, 0.0, 31.5, 0.0, 61.0, 23.5, 0.0, 0.0, 1.0]
FOREIGN = {
    "transforms.json": {
        "fl_x": 60,
        "fl_y": 61,
        "cx": 32,
        "cy": 24,
        "w": 64,
        "h": 48,
        "k1": 0.1,
        "frames": [],
    },
    "polycam.json": {"fx": 60, "fy": 61, "cx": 32, "cy": 24, "width": 64, "height": 48, "t_00": 1.0},
    "frames.json": {
        "frames": [
            {"fl_x": 60 + k, "fl_y": 61 + k, "cx": 32, "cy": 24, "w": 64, "h": 48} for k in (-0.1, 0.0, 0.1)
        ]
    },
    "metadata.json": {"K": [60, 0, 0, 0, 61, 0, 32, 24, 1], "w": 64, "h": 48, "poses": []},
    "ros.yaml": f"image_width: 64\nimage_height: 48\ncamera_matrix:\n  rows: 3\n  data: {MATRIX}\n"
    "distortion_model: plumb_bob\ndistortion_coefficients:\n  data: [0.1, 0, 0.01, 0, 0]\n",
    "opencv.yml": f"%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\ncamera_matrix: !!opencv-matrix\n"
    f"   rows: 3\n   cols: 3\n   dt: d\n   data: {MATRIX}\n",
    "kalibr.yaml": "cam0:\n  camera_model: pinhole\n  distortion_model: equidistant\n"
    "  distortion_coeffs: [0.1, 0, 0, 0]\n  intrinsics: [60, 61, 31.5, 23.5]\n  resolution: [64, 48]\n",
    "opencv.xml": "<?xml version='1.0'?><opencv_storage><image_width>64</image_width>"
    "<image_height>48</image_height><camera_matrix type_id='opencv-matrix'>"
    f"<data>{' '.join(map(str, MATRIX))}</data></camera_matrix></opencv_storage>",
    "metashape.xml": "<calibration><projection>frame</projection><width>64</width><height>48</height>"
    "<f>61</f><cx>0</cx><cy>0</cy><b1>-1</b1><k1>0.1</k1><p1>0.02</p1></calibration>",
}
MODELS_FOUND = {
    "transforms.json": ("FULL_OPENCV", (0.1, 0.0, 0.0, 0.0)),
    "ros.yaml": ("FULL_OPENCV", (0.1, 0.0, 0.01, 0.0)),
    "kalibr.yaml": ("OPENCV_FISHEYE", (0.1, 0.0, 0.0, 0.0)),
    "metashape.xml": ("FULL_OPENCV", (0.1, 0.0, 0.0, 0.02)),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_files_of_other_programs(tmp_path, name):
    (mount,) = read_calibration(write(tmp_path / name, FOREIGN[name])).mounts
    model, coefficients = MODELS_FOUND.get(name, ("PINHOLE", ()))
    assert (mount.camera.model, mount.camera.width, mount.camera.height) == (model, 64, 48)
    assert mount.camera.params[:8] == (60.0, 61.0, 32.0, 24.0, *coefficients)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", {"frames": []}, "found no camera with its size and focal length, wanted COLMAP's"),
        ("a.yaml", "a: [", "found damaged YAML"),
        ("a.xml", "<a>", "found damaged XML"),
        ("a.xml", "<!DOCTYPE a []><a/>", "a document type, which is not read"),
        ("a.txt", "cam0:\n", "line 1: 1 words"),
        ("a.json", {"w": 64, "h": 48, "fx": "wide"}, "could not|no camera|another kind"),
    ],
)
def test_damaged_files_of_other_programs_are_refused(tmp_path, name, content, message):
    assert_refused(message, read_calibration, write(tmp_path / name, content))


def test_colmaps_binary_cameras(tmp_path):
    content = struct.pack("<QIiQQ4d", 2, 1, 2, 64, 48, 60.0, 32.0, 24.0, 0.1)
    content += struct.pack("<IiQQ8d", 2, 4, 128, 96, *range(120, 128))
    (tmp_path / "cameras.bin").write_bytes(content)
    first, second = (mount.camera for mount in read_calibration(tmp_path / "cameras.bin").mounts)
    assert (first.model, first.params) == ("SIMPLE_RADIAL", (60.0, 32.0, 24.0, 0.1))
    assert (second.model, second.width, second.params) == ("OPENCV", 128, tuple(map(float, range(120, 128))))
    (tmp_path / "cameras.bin").write_bytes(content[:-1])
    assert_refused("found a file that is cut off, wanted", read_calibration, tmp_path / "cameras.bin")
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QIiQQ", 1, 1, 11, 64, 48) + bytes(128))
    assert_refused(
        "the camera model number 11, which is not read", read_calibration, tmp_path / "cameras.bin"
    )
