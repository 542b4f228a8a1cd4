"""Photos of any camera read as spheres: where each pixel comes to, what is valid, which camera is taken."""

import functools

import cv2
import numpy as np
import pytest
from pictures import encoded, smooth_rgb, with_metadata, write, xmp_packet
from PIL import Image
from PIL.ExifTags import IFD, Base
from refusals import assert_refused, read_or_refused
from rooms import room

from piccolo.camera import Calibration, Camera, Mount
from piccolo.camera.model import pinhole
from piccolo.camera.resampling import View, sphere_of, sphere_width
from piccolo.errors import InputError
from piccolo.geometry.pose import exp_so3
from piccolo.geometry.sphere import pixel_rays
from piccolo.panorama import GPano, ReadOptions, panorama_of_array, read_panorama
from piccolo.panorama.exif import focal_of
from piccolo.panorama.gpano import attitude_of_gravity, rotation_to_level
from piccolo.runtime.threads import Workers
from piccolo.scenes.synthetic.photographs import picture_by, picture_of_all
from piccolo.scenes.synthetic.world import make_query, photograph, room_of_query

BACK = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
TILT = tuple(map(tuple, exp_so3(np.array([0.3, -0.2, 2.0])).tolist()))
FISHEYE = Camera("OPENCV_FISHEYE", 400, 400, (118.0, 119.0, 201.0, 199.0, 0.01, -0.003, 0.0, 0.0), 96.0)
LENSES = {
    "pinhole": (Mount(pinhole(480, 360, 300.0)),),
    "wide": (Mount(Camera("OPENCV", 500, 400, (150.0, 152.0, 255.0, 190.0, -0.02, 0.001, 1e-3, -1e-3))),),
    "fisheye": (Mount(FISHEYE),),
    "dual fisheye": (Mount(FISHEYE, TILT), Mount(FISHEYE, BACK, offset=(400, 0))),
}


def calibrated(mounts):
    return ReadOptions(calibration=Calibration("made", tuple(mounts)))


@functools.lru_cache
def place():
    """A room, a pose in it, and its panorama there."""
    world, workers = room(5)[0], Workers(2)
    pose = make_query(world, 0, "tilt", 128, workers).pose
    this, _ = room_of_query(world, 0, "tilt")
    return this, pose, photograph(this, pose, 2048, workers)


@pytest.mark.parametrize("lens", LENSES)
def test_a_photo_becomes_the_part_of_the_sphere_that_it_shows(tmp_path, lens):
    """Cast along the camera's own rays, and resampled: the same as cast along the sphere's."""
    this, pose, full = place()
    mounts = LENSES[lens]
    rgb = picture_of_all(mounts, this, pose, Workers(2))
    panorama = read_panorama(write(tmp_path / "a.png", encoded(rgb, ".png")), calibrated(mounts))
    width = panorama.rgb.shape[1]
    assert panorama.cameras == mounts
    assert width == sphere_width(mounts)
    wanted = cv2.resize(full, (width, width // 2), interpolation=cv2.INTER_AREA).astype(int)
    difference = np.abs(panorama.rgb.astype(int) - wanted).max(axis=2)[panorama.is_valid]
    assert np.median(difference) <= 2
    assert np.mean(difference) < 4
    rays = pixel_rays(width)
    is_shown = np.any([m.camera.pixels(rays @ m.rotation.T)[1] for m in mounts], axis=0)
    assert (is_shown & ~panorama.is_valid).mean() < 0.01
    assert not (panorama.is_valid & ~is_shown).any()


def test_nothing_aliases_where_the_picture_is_finer_than_the_sphere():
    """Stripes of two pixels come out grey, also at a wide picture's rim, which is finer than its middle."""
    camera = pinhole(3000, 2400, 1000.0)
    stripes = np.zeros((2400, 3000, 4), np.uint8)
    stripes[:, ::2] = 255
    stripes[..., 3] = 255
    rgb, is_valid = sphere_of([View(Mount(camera), stripes)], 512)
    assert is_valid.mean() > 0.15
    assert np.abs(rgb[is_valid].astype(int) - 127).max() <= 6


def test_where_cameras_overlap_the_nearer_axis_counts():
    white = np.full((400, 400, 4), 255, np.uint8)
    black = white * np.uint8([0, 0, 0, 1])
    views = [View(Mount(FISHEYE), white), View(Mount(FISHEYE, BACK), black)]
    for order in (views, views[::-1]):
        rgb, is_valid = sphere_of(order, 512)
        assert is_valid.all()
        is_front = pixel_rays(512)[..., 0] > 0.002
        np.testing.assert_array_equal(rgb[..., 0][is_front], 255)
        np.testing.assert_array_equal(rgb[..., 0][pixel_rays(512)[..., 0] < -0.002], 0)


def test_the_sphere_is_as_fine_as_the_camera_and_bounded():
    assert sphere_width([Mount(pinhole(640, 480, 2048 / (2 * np.pi)))]) == 2048
    assert sphere_width([Mount(pinhole(640, 480, 330.0)), Mount(pinhole(640, 480, 100.0))]) == 2304
    assert sphere_width([Mount(pinhole(9000, 6000, 9000.0))]) == 4096
    assert sphere_width([Mount(pinhole(64, 48, 10.0))]) == 256


PHOTO = smooth_rgb(360, 480)


def photo(path, tags=None, orientation=1, size=(480, 360)):
    """A JPEG of PHOTO with EXIF."""
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    exif.get_ifd(IFD.Exif).update(tags or {})
    Image.fromarray(cv2.resize(PHOTO, size)).save(path, "JPEG", quality=95, exif=exif)
    return path


FILM = {Base.FocalLengthIn35mmFilm: 26}
PLANE = {
    Base.FocalLength: 4.5,
    Base.FocalPlaneXResolution: 480 / 6.0 * 25.4,
    Base.FocalPlaneResolutionUnit: 2,
    Base.ExifImageWidth: 480,
    Base.ExifImageHeight: 360,
}


def test_a_phone_photo_is_read_with_no_option(tmp_path):
    panorama = read_panorama(photo(tmp_path / "a.jpg", FILM))
    (mount,) = panorama.cameras
    focal = 26.0 / 43.2666 * 600.0  # its diagonal
    np.testing.assert_allclose(mount.camera.params, [focal, 240.0, 180.0], rtol=1e-5)
    fov = 2 * np.degrees(np.arctan(240 / focal))
    (note,) = panorama.warnings
    assert note.startswith(
        f"read as a pinhole photo {fov:.1f} deg wide, focal length {focal:.0f} px by EXIF's 35"
    )
    columns = np.flatnonzero(panorama.is_valid[len(panorama.rgb) // 2])
    assert len(columns) / panorama.rgb.shape[1] * 360.0 == pytest.approx(fov, abs=0.5)


def test_the_resolution_of_the_sensor_goes_before_the_rounded_equivalent():
    size = (480, 360)
    assert focal_of(PLANE, size).focal == pytest.approx(360.0)  # 4.5 mm of a sensor 6 mm wide
    assert focal_of({**PLANE, **FILM}, size).focal == pytest.approx(360.0)
    assert focal_of(PLANE, (240, 180)).focal == pytest.approx(180.0)  # made smaller since
    assert focal_of({**PLANE, Base.FocalPlaneResolutionUnit: 3}, size).focal == pytest.approx(914.4)
    cropped = {**PLANE, Base.FocalLengthIn35mmFilm: 52}
    assert focal_of(cropped, size).focal == pytest.approx(52.0 / 43.2666 * 600.0, rel=1e-5)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {Base.FocalLengthIn35mmFilm: 0},
        {Base.FocalLengthIn35mmFilm: 3},
        {Base.FocalLengthIn35mmFilm: "wide"},
        {Base.FocalLengthIn35mmFilm: (26, 27)},
        {Base.FocalLengthIn35mmFilm: float("nan")},
        {Base.FocalLength: 4.5},
        {**PLANE, Base.FocalPlaneXResolution: 1e-9},
        {**PLANE, Base.FocalPlaneResolutionUnit: 77},
    ],
)
def test_metadata_that_make_no_sense_count_as_missing(tags):
    assert focal_of(tags, (480, 360)) is None


@pytest.mark.parametrize("end", [20, 60, 90, 120])
def test_damaged_exif_does_not_crash(tmp_path, end):
    content = bytearray(photo(tmp_path / "a.jpg", {**FILM, **PLANE}).read_bytes())
    for seed in range(20):
        rng = np.random.default_rng(seed)
        content[30 + end : 50 + end] = rng.integers(0, 256, 20, dtype=np.uint8).tobytes()
        panorama, message = read_or_refused(read_panorama, write(tmp_path / "b.jpg", bytes(content)))
        assert (panorama is None) == bool(message)


def test_the_photo_is_turned_as_exif_says_and_so_is_its_calibration(tmp_path):
    """Held upright, orientation 6: the calibration is of the stored picture, the pose of the one shown."""
    upright = read_panorama(photo(tmp_path / "a.jpg", FILM, orientation=6))
    assert (upright.cameras[0].camera.width, upright.cameras[0].camera.height) == (360, 480)
    for orientation in (6, 8):
        path = photo(tmp_path / "b.jpg", FILM, orientation)
        shown = read_panorama(path)
        stored = Calibration("stored", (Mount(pinhole(480, 360, shown.cameras[0].camera.params[0])),))
        again = read_panorama(path, ReadOptions(calibration=stored))
        assert (again.cameras[0].camera.width, again.cameras[0].camera.height) == (480, 360)
        is_both = shown.is_valid & again.is_valid
        assert is_both.sum() > 0.98 * shown.is_valid.sum()
        assert np.abs(shown.rgb[is_both].astype(int) - again.rgb[is_both]).mean() < 1.0


def test_what_the_user_says_goes_before_exif(tmp_path):
    path = photo(tmp_path / "a.jpg", FILM)
    focals = {
        430.0: ReadOptions(focal_px=430.0),
        240.0: ReadOptions(fov_deg=90.0, projection="pinhole"),
        480.0 / np.pi: ReadOptions(fov_deg=180.0, projection="fisheye"),
        77.0: calibrated([Mount(pinhole(480, 360, 77.0))]),
    }
    for focal, options in focals.items():
        panorama = read_panorama(path, options)
        assert panorama.cameras[0].camera.params[0] == pytest.approx(focal)
        assert panorama.warnings == ()
    crop = read_panorama(path, ReadOptions(fov_deg=60.0))
    assert crop.cameras == ()
    assert crop.rgb.shape == (1440, 2880, 3)


def test_a_sphere_stays_a_sphere_whatever_its_exif(tmp_path):
    wide = photo(tmp_path / "a.jpg", FILM, size=(480, 240))
    assert read_panorama(wide).cameras == ()
    assert len(read_panorama(wide, ReadOptions(projection="pinhole")).cameras) == 1
    sphere = Calibration("made", (Mount(Camera("EQUIRECTANGULAR", 960, 480, (960.0, 480.0))),))
    np.testing.assert_array_equal(
        read_panorama(wide, ReadOptions(calibration=sphere)).rgb, read_panorama(wide).rgb
    )


def test_photos_of_which_nothing_is_known_are_refused(tmp_path):
    path = photo(tmp_path / "a.jpg")
    assert_refused(r"found 480 x 360, wanted .*\(EXIF, --focal, --camera\)", read_panorama, path)
    pinhole_only = ReadOptions(projection="pinhole")
    assert_refused("found no focal length in EXIF, wanted --focal", read_panorama, path, pinhole_only)
    wrong = calibrated([Mount(pinhole(640, 360, 100.0))])
    assert_refused("made: found a picture of 480 x 360 and a calibration for 640", read_panorama, path, wrong)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"focal_px": 0.0}, "--focal: found 0.0, wanted above 0"),
        ({"focal_px": float("nan")}, "--focal: found nan"),
        ({"focal_px": 500.0, "fov_deg": 60.0}, "--focal, --fov or --projection: wanted only one of them"),
        (
            {"projection": "cylinder"},
            "--projection: found 'cylinder', wanted one of equirectangular, pinhole",
        ),
        ({"projection": "fisheye"}, "--projection fisheye: found no --fov"),
        ({"gravity_vector": (0.0, 0.0, 0.0)}, "--gravity-vector: found .*, wanted three finite numbers"),
        ({"gravity_vector": (0.0, 0.0, float("inf"))}, "--gravity-vector: found"),
    ],
)
def test_options_that_mean_nothing_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        ReadOptions(**options)


def test_no_plane_shows_half_a_sphere():
    options = ReadOptions(fov_deg=179.5, projection="pinhole")
    with pytest.raises(InputError, match=r"--fov: found 179.5 of a pinhole, wanted less than 178"):
        panorama_of_array(PHOTO, np.ones(PHOTO.shape[:2], bool), options)


def test_a_mask_of_the_photo_goes_along(tmp_path):
    path = photo(tmp_path / "a.jpg", FILM)
    mask = np.zeros((360, 480), np.uint8)
    mask[:, 240:] = 255
    masked = ReadOptions(mask=write(tmp_path / "m.png", encoded(mask, ".png")))
    plain, half = read_panorama(path), read_panorama(path, masked)
    width = plain.rgb.shape[1]
    np.testing.assert_array_equal(half.is_valid[:, : width // 2 - 1], plain.is_valid[:, : width // 2 - 1])
    assert not half.is_valid[:, width // 2 :].any()


def test_gravity_gives_pitch_and_roll(tmp_path):
    rng = np.random.default_rng(3)
    for _ in range(20):
        gpano = GPano(rng.uniform(-89, 89), rng.uniform(-179, 179))
        down = rotation_to_level(gpano).T @ [0.0, 0.0, -9.81]
        found = attitude_of_gravity(tuple(down))
        np.testing.assert_allclose([found.pitch_deg, found.roll_deg], [gpano.pitch_deg, gpano.roll_deg])
    assert attitude_of_gravity((-1.0, 0.0, 0.0)) == GPano(90.0, 0.0)
    path = write(tmp_path / "a.png", encoded(smooth_rgb(), ".png"))
    assert read_panorama(path).gpano is None
    found = read_panorama(path, ReadOptions(gravity_vector=(0.0, 1.0, -1.0))).gpano
    assert found == GPano(0.0, pytest.approx(-45.0))
    told = with_metadata(encoded(smooth_rgb(), ".jpg"), xmp=xmp_packet({"PosePitchDegrees": 10}))
    path = write(tmp_path / "b.jpg", told)
    assert read_panorama(path).gpano == GPano(10.0, None)
    assert read_panorama(path, ReadOptions(gravity_vector=(0.0, 0.0, -2.0))).gpano == GPano(0.0, 0.0)


def test_the_elevation_in_exif_is_the_pitch(tmp_path):
    tags = {**FILM, 0x9405: 12.5}
    assert read_panorama(photo(tmp_path / "a.jpg", tags)).gpano == GPano(12.5, None)
    assert read_panorama(photo(tmp_path / "a.jpg", {**FILM, 0x9405: 99.0})).gpano is None


@functools.lru_cache
def four_sides():
    """Four cameras of 90 degrees, to all sides, upright."""
    turns = [exp_so3(np.radians([0.0, 0.0, 90.0 * k])) for k in range(4)]
    rotations = [tuple(map(tuple, R.tolist())) for R in turns]
    return tuple(Mount(pinhole(320, 320, 160.0), R, image=f"{k}.png") for k, R in enumerate(rotations))


def write_instant(folder, mounts, this, pose):
    folder.mkdir(parents=True)
    for mount in mounts:
        write(folder / mount.image, encoded(picture_by(mount, this, pose, Workers(2)), ".png"))
    return folder


def test_a_rig_is_one_sphere(tmp_path):
    this, pose, full = place()
    folder = write_instant(tmp_path / "1", four_sides(), this, pose)
    panorama = read_panorama(folder, calibrated(four_sides()))
    assert panorama.cameras == four_sides()
    assert panorama.warnings == ()
    width = panorama.rgb.shape[1]
    is_round = np.abs(pixel_rays(width)[:, 0, 2]) < np.sin(np.radians(35.0))  # all four reach that high
    assert panorama.is_valid[is_round].all()
    wanted = cv2.resize(full, (width, width // 2), interpolation=cv2.INTER_AREA).astype(int)
    assert np.abs(panorama.rgb.astype(int) - wanted)[panorama.is_valid].mean() < 4


def test_a_rig_says_how_far_apart_its_cameras_are(tmp_path):
    this, pose, _ = place()
    far = [Mount(m.camera, m.R_lens_from_cam, (0.0, 0.2, 0.0), image=m.image) for m in four_sides()[:2]]
    folder = write_instant(tmp_path / "1", far, this, pose)
    (note,) = read_panorama(folder, calibrated(far)).warnings
    assert note == "the rig's cameras are up to 0.20 m from its origin: near things come out displaced"
    (folder / "1.png").unlink()
    assert_refused("found 0 pictures for the camera '1.png' of made", read_panorama, folder, calibrated(far))
