import functools

import cv2
import numpy as np
import pytest
from pictures import crop_fields, encoded, with_metadata, write, xmp_packet

from piccolo.geometry.pose import exp_so3
from piccolo.geometry.sphere import pixel_rays, solid_angles
from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.masks import is_dual_fisheye
from piccolo.photo.photo import Photo
from piccolo.system.errors import InputError

WIDTH, HEIGHT = 1024, 512


@functools.lru_cache
def room(seed=0, level=140.0, contrast=60.0, noise=2.0, tilt=0.0):
    rays = pixel_rays(WIDTH) @ exp_so3(np.array([0.3, tilt, 0.1]) * tilt)
    rng = np.random.default_rng(seed)
    near = np.array([2.0, 1.4, 1.3]) + rng.uniform(-0.3, 0.3, 3)
    distance = (near / np.maximum(np.abs(rays), 1e-9)).min(axis=2)
    x, y, z = np.moveaxis(rays * distance[..., None], -1, 0)
    pattern = np.sin(5 * x + seed) * np.sin(6 * y) + np.sin(7 * z) + 0.5 * np.sin(23 * x) * np.sin(21 * y)
    channels = [level + contrast * 0.5 * np.roll(pattern, 9 * k, axis=1) for k in range(3)]
    return np.clip(np.stack(channels, axis=2) + rng.normal(0, noise, (HEIGHT, WIDTH, 3)), 0, 255)


def plain_room(ceiling=235.0, floor=90.0):
    """A room with flat ceiling and floor: plain, but no discs."""
    rays = pixel_rays(WIDTH)
    distance = (np.array([2.0, 1.5, 1.2]) / np.maximum(np.abs(rays), 1e-9)).min(axis=2)
    z = rays[..., 2] * distance
    image = room().copy()
    image[z > 1.19], image[z < -1.19] = ceiling, floor
    return image


def read(path, image, suffix=".jpg", xmp=None, **options):
    content = encoded(np.round(image).clip(0, 255).astype(np.uint8), suffix, [cv2.IMWRITE_JPEG_QUALITY, 92])
    content = with_metadata(content, xmp=xmp) if xmp else content
    return read_panorama(Photo(write(path, content), **options))


FROM_NADIR = 180.0 - (np.arange(HEIGHT) + 0.5) * 180.0 / HEIGHT  # [deg] of each row


def capped(image, half_angle, fill, pole="nadir"):
    angle = FROM_NADIR if pole == "nadir" else 180.0 - FROM_NADIR
    changed = image.copy()
    changed[angle < half_angle] = fill(changed)[angle < half_angle] if callable(fill) else fill
    return changed


def blurred(image):
    """As an editor does it: the cap smeared in the plane below."""
    return cv2.GaussianBlur(image, (0, 0), 12, borderType=cv2.BORDER_REPLICATE)


# pictures of rooms in which nothing is to be found
HONEST = {
    "room": room,
    "dark": lambda: room(1, level=9.0, contrast=12.0, noise=1.5),
    "darker": lambda: room(2, level=3.0, contrast=4.0, noise=1.0),
    "plain": plain_room,
    "white ceiling": lambda: plain_room(255.0, 255.0),
    "black floor": lambda: plain_room(200.0, 6.0),
    "noise": lambda: np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(float),
    "tilted": lambda: room(3, tilt=0.9),
    "soft": lambda: cv2.GaussianBlur(room(1), (0, 0), 6),
}


@pytest.mark.parametrize("make", HONEST.values(), ids=HONEST)
def test_nothing_is_masked_in_pictures_of_rooms(tmp_path, make):
    panorama = read(tmp_path / "a.jpg", make())
    assert panorama.warnings == ()
    assert panorama.is_valid.all()


def logo(image):
    changed = np.full_like(image, 235.0)
    changed[::7, ::5] = 20.0
    return changed


@pytest.mark.parametrize("half_angle", [10.0, 20.0, 33.0])
@pytest.mark.parametrize("pole", ["nadir", "zenith"])
@pytest.mark.parametrize("fill", [(250, 250, 250), (10, 10, 60), logo, blurred])
def test_a_disc_over_a_pole_is_found(tmp_path, half_angle, pole, fill):
    scene = room(noise=16.0) if fill is blurred else room()
    panorama = read(tmp_path / "a.jpg", capped(scene, half_angle, fill, pole))
    assert len(panorama.warnings) == 1
    assert f"masked a {pole} patch of " in panorama.warnings[0]
    angle = FROM_NADIR if pole == "nadir" else 180.0 - FROM_NADIR
    assert not panorama.is_valid[angle < half_angle - 0.3].any()
    assert panorama.is_valid[angle > half_angle + 1.5].all()


@pytest.mark.parametrize(("top", "bottom"), [(40, 0), (0, 90), (25, 60)])
def test_unfilled_poles_are_found(tmp_path, top, bottom):
    image = room(1).copy()
    ragged = (8 * np.sin(np.arange(WIDTH) / 20.0)).astype(int)
    rows = np.arange(HEIGHT)[:, None]
    is_unfilled = (rows < (top + ragged) * (top > 0)) | (rows >= HEIGHT - (bottom + ragged) * (bottom > 0))
    image[is_unfilled] = 0
    panorama = read(tmp_path / "a.jpg", image)
    assert not panorama.is_valid[is_unfilled].any()
    assert (~panorama.is_valid & ~is_unfilled).mean() < 0.04
    share = float((is_unfilled.mean(axis=1) * solid_angles(WIDTH) * WIDTH).sum() / (4 * np.pi))
    assert float(panorama.warnings[0].split()[3]) == pytest.approx(100 * share, abs=2.0)
    assert panorama.warnings[0].startswith("masked black borders: ")


def test_an_unfilled_strip_at_the_seam_is_found(tmp_path):
    image = room(2).copy()
    image[:, :100] = image[:, -30:] = 0
    is_valid = read(tmp_path / "a.jpg", image).is_valid
    assert not is_valid[:, :100].any()
    assert not is_valid[:, -30:].any()
    assert is_valid[:, 110:-40].all()


def test_a_ragged_corner_of_a_crop_is_found(tmp_path):
    image = room(3)[100:400].copy()
    is_corner = np.add.outer(np.arange(300)[::-1], np.arange(WIDTH)) < 90
    image[is_corner] = 0
    fields = crop_fields(0, 100, WIDTH, 300, (WIDTH, HEIGHT))
    is_valid = read(tmp_path / "a.jpg", image, xmp=xmp_packet(fields)).is_valid
    assert not is_valid[100:400][is_corner].any()
    assert is_valid[100:400].mean() > 0.97
    assert not is_valid[:100].any()


def test_a_black_picture_is_refused_and_black_poles_are_no_fisheyes(tmp_path):
    with pytest.raises(InputError, match="no pixel is left: all are masked or black"):
        read(tmp_path / "a.png", np.zeros((HEIGHT, WIDTH, 3)), ".png")
    for half_angle in (20, 40, 60):
        image = capped(capped(room(), half_angle, 0), half_angle, 0, "zenith")
        panorama = read(tmp_path / "a.jpg", image)
        assert panorama.is_valid[HEIGHT // 2 - 30 : HEIGHT // 2 + 30].all()


def fisheyes(radius=0.49, floor=0.0):
    """Two circles side by side, darker to their rims."""
    v, u = np.mgrid[:HEIGHT, :HEIGHT] + 0.5 - HEIGHT / 2
    distance = np.hypot(u, v) / (radius * HEIGHT)
    fall = np.clip(1.2 - 0.6 * distance, 0, 1) * (distance < 1)
    both = np.concatenate([room(0)[:, :HEIGHT], room(1)[:, :HEIGHT]], axis=1)
    return both * np.tile(fall, 2)[..., None] + floor


@pytest.mark.parametrize(("radius", "floor"), [(0.5, 0.0), (0.46, 6.0)])
def test_two_fisheyes_are_refused(tmp_path, radius, floor):
    with pytest.raises(InputError, match="two fisheye pictures side by side, wanted their calibration"):
        read(tmp_path / "a.insp", fisheyes(radius, floor))


def test_a_bright_upper_edge_shows_no_two_fisheyes_but_one_bad_row_does_not_hide_them():
    picture = np.asarray(fisheyes(), np.uint8)
    assert is_dual_fisheye(picture)
    picture[0] = 60
    assert is_dual_fisheye(picture)
    picture[: HEIGHT // 128] = 60
    assert not is_dual_fisheye(picture)


def checker_mask(width, height):
    mask = np.zeros((height, width), np.uint8)
    mask[: height // 4, width // 2 :] = 255
    return mask


@pytest.mark.parametrize("factor", [0.25, 1, 2])
def test_a_mask_of_any_size_is_applied(tmp_path, factor):
    mask = checker_mask(int(WIDTH * factor), int(HEIGHT * factor))
    file = write(tmp_path / "mask.png", encoded(mask, ".png"))
    is_valid = read(tmp_path / "a.jpg", room(), mask=file).is_valid
    np.testing.assert_array_equal(is_valid, checker_mask(WIDTH, HEIGHT) == 0)


def test_any_white_pixel_of_a_larger_mask_counts_and_the_nadir_is_masked(tmp_path):
    mask = np.zeros((2 * HEIGHT, 2 * WIDTH), np.uint8)
    mask[301, 401], mask[700, 800] = 128, 127
    file = write(tmp_path / "mask.png", encoded(mask, ".png"))
    is_valid = read(tmp_path / "a.jpg", room(), mask=file).is_valid
    assert np.argwhere(~is_valid).tolist() == [[150, 200]]
    is_valid = read(tmp_path / "a.jpg", room(), mask_nadir_deg=20.0).is_valid
    np.testing.assert_array_equal(is_valid, np.repeat((FROM_NADIR >= 20)[:, None], WIDTH, axis=1))
    for degrees in (-1.0, 91.0, float("nan")):
        with pytest.raises(InputError, match=r"`mask_nadir_deg`: found .*, wanted 0 to 90"):
            Photo("a.jpg", mask_nadir_deg=degrees)


def test_a_mask_of_a_crop_may_have_its_shape_or_the_spheres(tmp_path):
    image = room()[100:300, :600]
    options = {"fov_deg": 600 / WIDTH * 360}
    of_crop = np.zeros((200, 600), np.uint8)
    of_crop[:50] = 255
    file = write(tmp_path / "crop.png", encoded(of_crop, ".png"))
    top = (HEIGHT - 200) // 2
    is_valid = read(tmp_path / "a.jpg", image, mask=file, **options).is_valid
    assert (np.nonzero(is_valid.any(axis=1))[0][[0, -1]] == [top + 50, top + 199]).all()
    file = write(tmp_path / "full.png", encoded(checker_mask(WIDTH, HEIGHT), ".png"))
    is_valid = read(tmp_path / "a.jpg", image, mask=file, **options).is_valid
    assert is_valid[top:].sum() == 200 * 600
    file = write(tmp_path / "wrong.png", encoded(np.zeros((100, 100), np.uint8), ".png"))
    with pytest.raises(InputError, match=r"wrong.png: found a mask of 100 x 100, wanted the shape of 1024 x"):
        read(tmp_path / "a.jpg", image, mask=file, **options)


def test_a_folder_of_masks_is_looked_up_by_name(tmp_path):
    folder = tmp_path / "masks"
    folder.mkdir()
    write(folder / "a.png", encoded(checker_mask(64, 32), ".png"))
    is_valid = read(tmp_path / "a.jpg", room(), mask=folder).is_valid
    np.testing.assert_array_equal(is_valid, checker_mask(WIDTH, HEIGHT) == 0)
    panorama = read(tmp_path / "b.jpg", room(), mask=folder)
    assert panorama.is_valid.all()
    assert panorama.warnings == (f"found no mask b in {folder}",)
    with pytest.raises(InputError, match=r"none.png: cannot be read"):
        read(tmp_path / "a.jpg", room(), mask=tmp_path / "none.png")


def test_true_written_as_1_is_ignored(tmp_path):
    mask = (checker_mask(WIDTH, HEIGHT) > 0).astype(np.uint8)
    is_valid = read(
        tmp_path / "a.jpg", room(), mask=write(tmp_path / "m.png", encoded(mask, ".png"))
    ).is_valid
    np.testing.assert_array_equal(is_valid, mask == 0)
