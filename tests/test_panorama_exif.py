"""Photos read by their metadata and options: which camera is taken, and what goes before what."""

import math

import cv2
import numpy as np
import pytest
from cameras import calibrated
from pictures import encoded, smooth_rgb, with_metadata, write, xmp_packet
from PIL import Image
from PIL.ExifTags import IFD, Base
from refusals import assert_input_error, assert_refused, read_or_refused

from piccolo.photo.camera import Calibration, Camera, Mount
from piccolo.photo.camera.model import pinhole
from piccolo.photo.panorama import GPano, read_panorama
from piccolo.photo.panorama.facts import read_focal_length
from piccolo.photo.panorama.gpano import attitude_of_gravity, rotation_to_level
from piccolo.photo.photo import Photo

PHOTO = smooth_rgb(360, 480)


def photo(path, tags=None, orientation=1, size=(480, 360)):
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
    words = f"pinhole photo {fov:.1f} deg wide, focal length {focal:.0f} px from EXIF's 35"
    assert note.startswith(f"read as a {words}")
    columns = np.flatnonzero(panorama.is_valid[len(panorama.rgb) // 2])
    assert len(columns) / panorama.rgb.shape[1] * 360.0 == pytest.approx(fov, abs=0.5)


def test_a_photo_twice_as_wide_as_high_is_read_as_a_sphere_with_a_warning(tmp_path):
    path = photo(tmp_path / "a.jpg", FILM, size=(480, 240))
    panorama = read_panorama(path)
    assert panorama.cameras == ()
    (note,) = panorama.warnings
    assert note.startswith("read as a full sphere, as it is 2:1; if it is a photo, add `projection` pinhole")
    assert "EXIF's 35 mm equivalent of 26 mm (" in note
    assert len(read_panorama(Photo(path, projection="pinhole")).cameras) == 1
    for quiet in (Photo(path, projection="equirectangular"), Photo(path, fov_deg=360.0)):
        assert read_panorama(quiet).warnings == ()
    assert read_panorama(photo(tmp_path / "b.jpg", size=(480, 240))).warnings == ()
    sphere = with_metadata(path.read_bytes(), xmp=xmp_packet({"ProjectionType": "equirectangular"}))
    assert read_panorama(write(tmp_path / "c.jpg", sphere)).warnings == ()
    given = Calibration("made", (Mount(Camera("EQUIRECTANGULAR", 960, 480, (960.0, 480.0))),))
    np.testing.assert_array_equal(read_panorama(Photo(path, camera=given)).rgb, panorama.rgb)


def test_the_resolution_of_the_sensor_goes_before_the_rounded_equivalent():
    size = (480, 360)
    assert read_focal_length(PLANE, size).focal == pytest.approx(360.0)  # 4.5 mm of a sensor 6 mm wide
    assert read_focal_length({**PLANE, **FILM}, size).focal == pytest.approx(360.0)
    assert read_focal_length(PLANE, (240, 180)).focal == pytest.approx(180.0)  # made smaller since
    assert read_focal_length({**PLANE, Base.FocalPlaneResolutionUnit: 3}, size).focal == pytest.approx(914.4)
    cropped = {**PLANE, Base.FocalLengthIn35mmFilm: 52}
    assert read_focal_length(cropped, size).focal == pytest.approx(52.0 / 43.2666 * 600.0, rel=1e-5)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {Base.FocalLengthIn35mmFilm: 3},
        {Base.FocalLengthIn35mmFilm: "wide"},
        {Base.FocalLengthIn35mmFilm: float("nan")},
        {Base.FocalLength: 4.5},
        {**PLANE, Base.FocalPlaneXResolution: 1e-9},
        {**PLANE, Base.FocalPlaneResolutionUnit: 77},
    ],
)
def test_metadata_that_make_no_sense_count_as_missing(tags):
    assert read_focal_length(tags, (480, 360)) is None


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
        again = read_panorama(Photo(path, camera=stored))
        assert (again.cameras[0].camera.width, again.cameras[0].camera.height) == (480, 360)
        is_both = shown.is_valid & again.is_valid
        assert is_both.sum() > 0.98 * shown.is_valid.sum()
        assert np.abs(shown.rgb[is_both].astype(int) - again.rgb[is_both]).mean() < 1.0


def test_what_the_user_says_goes_before_exif(tmp_path):
    path = photo(tmp_path / "a.jpg", FILM)
    focals = {
        430.0: Photo(path, focal_px=430.0),
        240.0: Photo(path, fov_deg=90.0, projection="pinhole"),
        480.0 / np.pi: Photo(path, fov_deg=180.0, projection="fisheye"),
        77.0: calibrated(path, [Mount(pinhole(480, 360, 77.0))]),
    }
    for focal, asked in focals.items():
        panorama = read_panorama(asked)
        assert panorama.cameras[0].camera.params[0] == pytest.approx(focal)
        assert panorama.warnings == ()
    crop = read_panorama(Photo(path, fov_deg=60.0, projection="equirectangular"))
    assert (crop.cameras, crop.warnings) == ((), ())
    assert crop.rgb.shape == (1440, 2880, 3)


@pytest.mark.parametrize("size", [(480, 360), (360, 480), (480, 320), (480, 270), (480, 271)])
def test_a_field_of_view_alone_makes_no_pinhole_of_a_photo_and_a_warning_says_so(tmp_path, size):
    panorama = read_panorama(Photo(photo(tmp_path / "a.jpg", size=size), fov_deg=65.0))
    assert panorama.cameras == ()
    (warning,) = panorama.warnings
    assert "part of a panorama" in warning
    assert "for a photo add `projection` pinhole" in warning


def test_a_part_of_a_panorama_is_not_taken_for_a_photo(tmp_path):
    path = photo(tmp_path / "a.jpg", size=(480, 200))
    assert read_panorama(Photo(path, fov_deg=65.0)).warnings == ()
    sphere = with_metadata(encoded(PHOTO, ".jpg"), xmp=xmp_packet({"PosePitchDegrees": 10}))
    path = write(tmp_path / "b.jpg", sphere)
    assert read_panorama(Photo(path, fov_deg=65.0)).warnings == ()


def test_photos_of_which_nothing_is_known_are_refused(tmp_path):
    path = photo(tmp_path / "a.jpg")
    message = (
        r"found a picture of 480 x 360, .* no focal length in EXIF\. If a camera .* `fov_deg` 65 `refine"
    )
    assert_refused(message, read_panorama, path)
    upright = photo(tmp_path / "b.jpg", orientation=6)
    assert_refused("found a picture of 360 x 480, .* `fov_deg` 50 `refine_focal`", read_panorama, upright)
    pinhole_only = Photo(path, projection="pinhole")
    assert_refused("found no focal length in EXIF, wanted `focal_px`", read_panorama, pinhole_only)
    wrong = calibrated(path, [Mount(pinhole(640, 360, 100.0))])
    assert_refused("made: found a picture of 480 x 360 and a calibration for 640", read_panorama, wrong)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"focal_px": 0.0}, "`focal_px`: found 0.0, wanted above 0"),
        ({"focal_px": 500.0, "fov_deg": 60.0}, "`focal_px`, `fov_deg` or `projection`: wanted only one"),
        ({"projection": "cylinder"}, "`projection`: found 'cylinder', wanted one of equirectangular, pin"),
        ({"projection": "fisheye"}, "`projection` fisheye: found no `fov_deg`"),
    ],
)
def test_options_that_mean_nothing_are_refused(options, message):
    assert_input_error(message, Photo, "a.jpg", **options)


def test_no_plane_shows_half_a_sphere():
    wide = Photo(PHOTO, fov_deg=179.5, projection="pinhole")
    assert_input_error(r"`fov_deg`: found 179.5 of a pinhole, wanted less than 178", read_panorama, wide)


def test_a_mask_of_the_photo_goes_along(tmp_path):
    path = photo(tmp_path / "a.jpg", FILM)
    mask = np.zeros((360, 480), np.uint8)
    mask[:, 240:] = 255
    masked = Photo(path, mask=write(tmp_path / "m.png", encoded(mask, ".png")))
    plain, half = read_panorama(path), read_panorama(masked)
    width = plain.rgb.shape[1]
    np.testing.assert_array_equal(half.is_valid[:, : width // 2 - 1], plain.is_valid[:, : width // 2 - 1])
    assert not half.is_valid[:, width // 2 :].any()


def test_gravity_gives_pitch_and_roll():
    rng = np.random.default_rng(3)
    for _ in range(20):
        gpano = GPano(rng.uniform(-89, 89), rng.uniform(-179, 179))
        down = rotation_to_level(gpano).T @ [0.0, 0.0, -9.81]
        found = attitude_of_gravity(tuple(down))
        np.testing.assert_allclose([found.pitch_deg, found.roll_deg], [gpano.pitch_deg, gpano.roll_deg])
    assert attitude_of_gravity((-1.0, 0.0, 0.0)) == GPano(90.0, 0.0)
    assert attitude_of_gravity((0.0, 1.0, -1.0)) == GPano(0.0, pytest.approx(-45.0))


def test_the_elevation_in_exif_is_the_pitch(tmp_path):
    tags = {**FILM, 0x9405: 12.5}
    assert read_panorama(photo(tmp_path / "a.jpg", tags)).gpano == GPano(12.5, None)
    assert read_panorama(photo(tmp_path / "a.jpg", {**FILM, 0x9405: 99.0})).gpano is None


@pytest.mark.parametrize(
    ("size", "most"), [((480, 270), 600), ((270, 480), 600), ((360, 360), 360 * 3.25**0.5)]
)
def test_the_equivalent_of_a_cropped_picture_may_be_that_of_the_whole_sensor(size, most):
    found = read_focal_length(FILM, size)
    ends = np.log([26.0 / 43.2666 * np.hypot(*size), 26.0 / 43.2666 * most])
    assert np.log(found.focal) == pytest.approx(ends.mean(), abs=1e-5)
    assert np.ptp(ends) / 2.0 < found.deviation < np.ptp(ends) / 2.0 + 0.01
    assert f"({np.exp(ends[0]):.0f} px for this shape of sensor, up to {np.exp(ends[1]):.0f}" in found.source


def test_pictures_of_the_shape_of_a_sensor_have_one_reading():
    for size in ((480, 360), (360, 480), (480, 320)):
        found = read_focal_length(FILM, size)
        assert found.focal == 26.0 / math.hypot(36.0, 24.0) * math.hypot(*size)
        assert found.source == "EXIF's 35 mm equivalent of 26 mm"
