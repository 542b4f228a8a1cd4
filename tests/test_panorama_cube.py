import cv2
import numpy as np
import pytest
from pictures import encoded, write
from refusals import assert_refused

from piccolo.geometry.sphere import pixel_rays
from piccolo.photo.panorama import read_panorama
from piccolo.photo.photo import Photo
from piccolo.system.errors import InputError

SIZE = 64
# forward, right and up of each face's picture, by hand: +x the panorama's centre, +y left, +z up
AXES = {
    "r": ([0, -1, 0], [-1, 0, 0], [0, 0, 1]),
    "l": ([0, 1, 0], [1, 0, 0], [0, 0, 1]),
    "u": ([0, 0, 1], [0, -1, 0], [-1, 0, 0]),
    "d": ([0, 0, -1], [0, -1, 0], [1, 0, 0]),
    "f": ([1, 0, 0], [0, -1, 0], [0, 0, 1]),
    "b": ([-1, 0, 0], [0, 1, 0], [0, 0, 1]),
}
NAMES = {
    "matterport": [f"ab_skybox{k}_sami" for k in (2, 4, 0, 5, 1, 3)],
    "opengl": ["px", "nx", "py", "ny", "pz", "nz"],
    "signs": ["sky_posx", "sky_negx", "sky_posy", "sky_negy", "sky_posz", "sky_negz"],
    "words": ["pano-Right", "pano-Left", "pano-Up", "pano-Down", "pano-Front", "pano-Back"],
    "top": ["right", "left", "top", "bottom", "front", "back"],
    "letters": ["7_r", "7_l", "7_u", "7_d", "7_f", "7_b"],
}


def sphere_colors(rays):
    """Smooth colours (..., 3) that tell every direction from every other."""
    x, y, z = np.moveaxis(rays, -1, 0)
    channels = [x + 0.3 * np.sin(3 * z), y + 0.3 * np.cos(4 * x), z + 0.3 * np.sin(2 * y + x)]
    return np.round(127.5 + 90 * np.stack(channels, axis=-1)).astype(np.uint8)


def face(letter, size=SIZE):
    forward, right, up = np.array(AXES[letter], float)
    a = (np.arange(size) + 0.5) * 2 / size - 1
    rays = forward + a[None, :, None] * right - a[:, None, None] * up
    return sphere_colors(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


EXPECTED = sphere_colors(pixel_rays(4 * SIZE)).astype(int)


def assert_is_the_sphere(panorama):
    assert panorama.rgb.shape == (2 * SIZE, 4 * SIZE, 3)
    difference = np.abs(panorama.rgb - EXPECTED)
    assert difference.max() <= 3  # at the seams of the cube as well
    assert difference.mean() < 0.6
    assert panorama.is_valid.all()


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
def test_a_folder_of_faces_becomes_the_sphere(tmp_path, names):
    for letter, name in zip("rludfb", names, strict=True):
        write(tmp_path / f"{name}.png", encoded(face(letter), ".png"))
    write(tmp_path / "notes.txt", b"")
    write(tmp_path / "preview.jpg", b"no picture")
    assert_is_the_sphere(read_panorama(tmp_path))


def test_a_large_face_takes_several_bands_and_chunks(tmp_path):
    for letter, name in zip("rludfb", NAMES["opengl"], strict=True):
        write(tmp_path / f"{name}.png", encoded(face(letter, 300), ".png"))
    rgb = read_panorama(tmp_path).rgb
    assert np.abs(rgb - sphere_colors(pixel_rays(1200)).astype(int)).max() <= 2


def test_alpha_of_a_face_is_kept(tmp_path):
    for letter, name in zip("rludfb", NAMES["opengl"], strict=True):
        alpha = np.full((SIZE, SIZE, 1), 0 if letter == "l" else 255, np.uint8)
        write(tmp_path / f"{name}.png", encoded(np.dstack([face(letter), alpha]), ".png"))
    is_valid = read_panorama(tmp_path).is_valid
    is_left = pixel_rays(4 * SIZE)[..., 1] > np.sqrt(0.5) + 0.02
    assert not is_valid[is_left].any()
    assert is_valid.mean() == pytest.approx(5 / 6, abs=0.1)


def picture_of(rows):
    cells = {"-": np.zeros((SIZE, SIZE, 3), np.uint8), "B": face("b")[::-1, ::-1]}
    return np.vstack([np.hstack([cells[c] if c in cells else face(c) for c in row]) for row in rows])


@pytest.mark.parametrize("rows", [["-u--", "lfrb", "-d--"], ["-u-", "lfr", "-d-", "-B-"]])
def test_crosses_are_known_by_their_empty_cells(tmp_path, rows):
    assert_is_the_sphere(read_panorama(write(tmp_path / "a.png", encoded(picture_of(rows), ".png"))))
    jpeg = encoded(picture_of(rows), ".jpg", [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert read_panorama(write(tmp_path / "a.jpg", jpeg)).rgb.shape == (2 * SIZE, 4 * SIZE, 3)
    full = picture_of([row.replace("-", "f") for row in rows])
    with pytest.raises(InputError, match="which is no full panorama"):
        read_panorama(write(tmp_path / "b.png", encoded(full, ".png")))


@pytest.mark.parametrize("rows", [["rludfb"], list("rludfb"), ["fbl", "rud"], ["du", "fb", "lr"]])
def test_grids_are_read_by_the_order_given(tmp_path, rows):
    path = write(tmp_path / "a.png", encoded(picture_of(rows), ".png"))
    assert_refused(r"`cube_order`", read_panorama, path)
    assert_is_the_sphere(read_panorama(Photo(path, cube_order="".join(rows))))


def test_orders_and_shapes_that_are_no_cube_are_refused(tmp_path):
    for order in ("", "rlud", "rludff", "rludfx"):
        with pytest.raises(InputError, match=r"`cube_order`: found .*, wanted each of the letters rludfb"):
            Photo("a.jpg", cube_order=order)
    path = write(tmp_path / "a.png", encoded(picture_of(["fl"]), ".png"))
    with pytest.raises(InputError, match="found 128 x 64, wanted six equal squares as cube_order says"):
        read_panorama(Photo(path, cube_order="rludfb"))


def test_folders_that_are_no_cube_are_refused(tmp_path):
    for letter, name in zip("rludf", NAMES["opengl"], strict=False):
        write(tmp_path / f"{name}.png", encoded(face(letter), ".png"))
    assert_refused("not a file but a folder with 0 complete cubes, wanted six faces", read_panorama, tmp_path)
    path = write(tmp_path / "nz.png", encoded(face("b", 32), ".png"))
    assert_refused("found cube faces of 32 x 32, 64 x 64, wanted six squares of one", read_panorama, tmp_path)
    write(path, encoded(face("b")[:, :40], ".png"))
    assert_refused("found cube faces of 40 x 64, 64 x 64, wanted six squares", read_panorama, tmp_path)
    write(path, b"GIF89a")
    assert_refused(r"nz.png: begins with b'GIF89a'", read_panorama, tmp_path)
    for letter, name in zip("rludfb", NAMES["letters"], strict=True):
        write(tmp_path / f"{name}.png", encoded(face(letter), ".png"))
        write(tmp_path / f"8{name}.png", encoded(face(letter), ".png"))
    assert_refused("with 3 complete cubes, wanted six faces", read_panorama, tmp_path)
