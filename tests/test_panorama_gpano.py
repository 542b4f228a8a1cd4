import time
import zlib

import cv2
import numpy as np
import pytest
from pictures import (
    XMP_NAMESPACE,
    crop_fields,
    encoded,
    png_chunk,
    smooth_rgb,
    tiff,
    with_metadata,
    write,
    xmp_packet,
)
from refusals import assert_refused, read_or_refused

from piccolo.photo.panorama import GPano, read_panorama
from piccolo.photo.panorama.gpano import gpano_fields, rotation_to_level
from piccolo.photo.photo import Photo
from piccolo.system.errors import InputError

RGB = smooth_rgb(200, 400)
LOSSLESS = [cv2.IMWRITE_WEBP_QUALITY, 101]


def file_of(rgb, fields, suffix=".png", **form):
    xmp = xmp_packet(fields, **form)
    if suffix == ".tif":
        return tiff(rgb, {700: (1, list(xmp))})
    options = LOSSLESS if suffix == ".webp" else [cv2.IMWRITE_JPEG_QUALITY, 98]
    return with_metadata(encoded(rgb, suffix, options), xmp=xmp)


def expected_crop(left, top, width, height):
    is_valid = np.zeros((200, 400), bool)
    is_valid[top : top + height, left : left + width] = True
    return np.where(is_valid[..., None], RGB, 0), is_valid


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp"])
@pytest.mark.parametrize("form", ["attributes", "elements"])
def test_a_crop_is_placed_in_the_sphere(tmp_path, suffix, form):
    content = file_of(RGB[30:170, 50:290], crop_fields(50, 30, 240, 140), suffix, form=form, prefix="pano")
    panorama = read_panorama(write(tmp_path / "a", content))
    rgb, is_valid = expected_crop(50, 30, 240, 140)
    np.testing.assert_array_equal(panorama.is_valid, is_valid)
    assert np.abs(panorama.rgb.astype(int) - rgb).max() <= (8 if suffix == ".jpg" else 0)
    assert panorama.gpano == GPano()
    assert panorama.warnings == ()


def test_packed_xmp_in_png_is_read_and_a_bomb_is_not(tmp_path):
    crop = encoded(RGB[30:170, 50:290], ".png")
    for xmp, is_read in ((xmp_packet(crop_fields(50, 30, 240, 140)), True), (bytes(50_000_000), False)):
        chunk = png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(xmp))
        path = write(tmp_path / "a.png", crop[:33] + chunk + crop[33:])
        panorama, message = read_or_refused(read_panorama, path)
        assert (panorama is not None) == is_read
        assert is_read or "too large" in message


def test_the_crop_of_a_picture_made_smaller_is_placed_by_ratio(tmp_path):
    crop = cv2.resize(RGB[40:180, 100:300], (100, 70), interpolation=cv2.INTER_AREA)
    large = np.kron(crop, np.ones((2, 2, 1), np.uint8))
    content = file_of(large, crop_fields(1000, 400, 2000, 1400, (4000, 2000)))
    panorama = read_panorama(write(tmp_path / "a", content))
    rows, columns = np.nonzero(panorama.is_valid)
    assert panorama.rgb.shape == (200, 400, 3)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (40, 179, 100, 299)
    assert np.abs(panorama.rgb.astype(int) - RGB)[panorama.is_valid].max() <= 3


@pytest.mark.parametrize("left", [-100, 300])
def test_a_crop_over_the_seam_goes_on_at_the_other_side(tmp_path, left):
    rolled = np.roll(RGB, 100, axis=1)[20:180, :260]
    panorama = read_panorama(write(tmp_path / "a", file_of(rolled, crop_fields(left, 20, 260, 160))))
    is_valid = np.zeros((200, 400), bool)
    is_valid[20:180, :160] = is_valid[20:180, 300:] = True
    np.testing.assert_array_equal(panorama.is_valid, is_valid)
    np.testing.assert_array_equal(panorama.rgb[is_valid], RGB[is_valid])


@pytest.mark.parametrize(
    "fields",
    [
        crop_fields(0, 0, 0, 0),
        crop_fields(0, 0, "nan", "nan"),
        crop_fields(0, 0, "many", 200),
        crop_fields(0, 150, 400, 200, (800, 300)),
        crop_fields(999, 0, 400, 200),
        crop_fields(0, 0, 400, 100),
        {"FullPanoWidthPixels": 800},
    ],
)
def test_a_crop_that_makes_no_sense_is_refused_or_left_aside(tmp_path, fields):
    panorama = read_panorama(write(tmp_path / "a", file_of(RGB, fields)))
    np.testing.assert_array_equal(panorama.rgb, RGB)
    assert panorama.is_valid.all()
    assert "the crop in the metadata is invalid" in panorama.warnings[0]
    with pytest.raises(InputError, match=r"found a picture of 300 x 200, .* and a crop in the metadata"):
        read_panorama(write(tmp_path / "b", file_of(RGB[:, :300], fields)))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (crop_fields(0, 0, 300, 200, (70_000, 35_000)), "found 300 x 200 of a sphere 70000 wide, wanted"),
        (crop_fields(0, 0, 300, 200, (9000, 4500)), "found 300 x 200, 0.15 % of the sphere, wanted at least"),
        (crop_fields(0, 0, 300, 200, (900, 250)), "of a sphere of 900 x 250, wanted that width = 2 x height"),
        ({"ProjectionType": "Cylin\ndrical"}, "names the projection .cylin.+ndrical., wanted equirect"),
    ],
)
def test_crops_are_refused_by_name(tmp_path, fields, message):
    assert_refused(message, read_panorama, write(tmp_path / "a", file_of(RGB[:, :300], fields)))


def test_the_attitude_is_read_and_an_entity_bomb_is_not_expanded(tmp_path):
    fields = {"PosePitchDegrees": "+3.5", "PoseRollDegrees": -120.25}
    assert read_panorama(write(tmp_path / "a", file_of(RGB, fields))).gpano == GPano(3.5, -120.25)
    fields = {"PosePitchDegrees": 91, "PoseRollDegrees": "1e999"}
    assert read_panorama(write(tmp_path / "a", file_of(RGB, fields))).gpano == GPano()
    assert read_panorama(write(tmp_path / "a", encoded(RGB, ".png"))).gpano is None
    steps = (f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">'.encode() for k in range(20))
    bomb = b'<!DOCTYPE a [<!ENTITY a "aaaaaaaa">' + b"".join(steps)
    xmp = bomb + b"]>" + xmp_packet({"PosePitchDegrees": "&u;"})
    panorama = read_panorama(write(tmp_path / "a.jpg", with_metadata(encoded(RGB, ".jpg"), xmp=xmp)))
    assert panorama.gpano == GPano()


def test_pitch_raises_the_image_centre_and_roll_lowers_the_right_side():
    R_level_from_cam = rotation_to_level(GPano(pitch_deg=30.0))
    np.testing.assert_allclose(R_level_from_cam @ [1, 0, 0], [np.cos(np.pi / 6), 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(R_level_from_cam @ [0, 1, 0], [0, 1, 0], atol=1e-12)
    R_level_from_cam = rotation_to_level(GPano(roll_deg=20.0))
    np.testing.assert_allclose(R_level_from_cam @ [1, 0, 0], [1, 0, 0], atol=1e-12)
    assert (R_level_from_cam @ [0, -1, 0])[2] == pytest.approx(-np.sin(np.radians(20)))
    assert rotation_to_level(GPano()) is None


@pytest.mark.parametrize(("pitch", "roll"), [(25.0, -40.0), (-10.0, 170.0), (89.0, 5.0)])
def test_the_order_is_heading_pitch_roll_about_the_cameras_axes(pitch, roll):
    R_level_from_cam = rotation_to_level(GPano(pitch_deg=pitch, roll_deg=roll))
    np.testing.assert_allclose(R_level_from_cam @ R_level_from_cam.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R_level_from_cam) == pytest.approx(1.0)
    # roll leaves the image centre where pitch put it
    elevation = np.degrees(np.arcsin((R_level_from_cam @ [1, 0, 0])[2]))
    assert elevation == pytest.approx(pitch)
    # the camera's left axis is at the roll's angle against the level one before pitch
    left = R_level_from_cam @ [0, 1, 0]
    assert left[2] == pytest.approx(np.sin(np.radians(roll)) * np.cos(np.radians(pitch)))


def test_a_field_of_view_is_centred_on_the_horizon(tmp_path):
    path = write(tmp_path / "a.png", encoded(RGB[60:140, 100:300], ".png"))
    message = r"found a picture of 200 x 80, which is no full .* part of a panorama, give `fov_deg`"
    assert_refused(message, read_panorama, path)
    panorama = read_panorama(Photo(path, fov_deg=180.0))
    rgb, is_valid = expected_crop(100, 60, 200, 80)
    np.testing.assert_array_equal(panorama.is_valid, is_valid)
    np.testing.assert_array_equal(panorama.rgb, rgb)
    around = read_panorama(Photo(path, fov_deg=360.0))
    assert around.rgb.shape == (100, 200, 3)
    assert around.is_valid[10:90].all()
    for fov_deg in (0.0, -90.0, 361.0, float("nan")):
        with pytest.raises(InputError, match=r"`fov_deg`: found .*, wanted above 0 and at most 360"):
            Photo("a.jpg", fov_deg=fov_deg)
    with pytest.raises(InputError, match=r"found 200 x 200, higher than the sphere .* a smaller `fov_deg`"):
        read_panorama(Photo(write(path, encoded(RGB[:, :200], ".png")), fov_deg=270.0))


def test_many_prefixes_of_the_namespace_cost_no_time():
    space = f'xmlns:p{{}}="{XMP_NAMESPACE}" p{{}}:PosePitchDegrees="{{}}" '
    xmp = b"".join(space.format(k, k, k).encode() for k in range(12_000))
    begin = time.perf_counter()
    assert gpano_fields(xmp) == {"PosePitchDegrees": "0"}
    assert time.perf_counter() - begin < 2.0


def test_a_strip_with_its_own_height_as_that_of_the_sphere_lies_on_the_horizon(tmp_path):
    panorama = read_panorama(
        write(tmp_path / "a", file_of(RGB[50:150], crop_fields(0, 0, 400, 100, (400, 100))))
    )
    assert panorama.is_valid[50:150].all()
    assert panorama.is_valid.sum() == 100 * 400
    np.testing.assert_array_equal(panorama.rgb[50:150], RGB[50:150])
    words = "the metadata call the crop's height the sphere's: its horizon is assumed to be in the middle"
    assert panorama.warnings == (words,)
    part = read_panorama(
        write(tmp_path / "b", file_of(RGB[20:120, :300], crop_fields(0, 0, 300, 100, (400, 100))))
    )
    assert part.is_valid[50:150, :300].all()
    assert part.warnings == (words,)
    whole = file_of(RGB, crop_fields(0, 0, 400, 200))
    assert read_panorama(write(tmp_path / "c", whole)).warnings == ()
