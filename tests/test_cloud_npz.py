import io
import shutil
import zipfile

import numpy as np
import pytest
from clouds import read, seeded_cloud
from refusals import assert_refused
from scans import read_cloud

from piccolo.cloud.cloud_settings import IN_COLORS
from piccolo.cloud.readers import npz
from piccolo.cloud.stream import open_source
from piccolo.scan_map.map_file import FORMAT, is_map_file, load_map

TIER = "scene"

RAW = seeded_cloud(1, num_points=1200)
XYZ, RGB = RAW.points_world, RAW.colors
WHOLE = np.hstack([XYZ, RGB])
PAIR = {"points": XYZ, "colors": RGB}
SAVERS = [np.savez, np.savez_compressed]


def save(path, array):
    np.save(path, array, allow_pickle=False)
    return path


def assert_read_as_written(path, points_world=XYZ):
    assert open_source(path).num_points == 1200
    found, colors = read(path)
    np.testing.assert_array_equal(found, points_world)
    np.testing.assert_array_equal(colors, RGB)


ARRAYS = {"float": WHOLE, "fortran": np.asfortranarray(WHOLE)}
ARRAYS |= {"big-endian": WHOLE.astype(">f8"), "float32": WHOLE.astype("f4")}


@pytest.mark.parametrize("kind", ARRAYS)
@pytest.mark.parametrize("chunk", [7, 1200, 1 << 20])
def test_single_arrays(tmp_path, read_by, kind, chunk):
    read_by(chunk)
    array = ARRAYS[kind]
    assert_read_as_written(save(tmp_path / "a.npy", array), array[:, :3])
    shutil.copy(tmp_path / "a.npy", tmp_path / "scan.txt")
    assert_read_as_written(tmp_path / "scan.txt", array[:, :3])
    sizes = [len(part.colors) for part in open_source(tmp_path / "a.npy").read_chunks()]
    assert max(sizes) == min(chunk, 1200)


@pytest.mark.parametrize("saver", SAVERS)
@pytest.mark.parametrize("names", [("points", "colors"), ("xyz", "rgb"), ("points", "rgb")])
@pytest.mark.parametrize(("kind", "top"), [("u1", 255), ("<u2", 65535), (">u2", 65535), ("f4", 1), ("f8", 1)])
def test_pairs_of_arrays(tmp_path, read_by, saver, names, kind, top):
    read_by(500)
    colors = (RGB * (top / 255.0)).astype(kind)
    path = tmp_path / "a.npz"
    saver(path, other=np.arange(5), **{names[1]: colors, names[0]: np.asfortranarray(XYZ.astype("f4"))})
    assert_read_as_written(path, XYZ.astype("f4"))
    assert not is_map_file(path)


def test_a_cloud_is_no_map_whatever_its_arrays_are_called(tmp_path):
    np.savez(tmp_path / "a.npz", point_format=np.arange(3), points=XYZ, colors=RGB)
    assert_read_as_written(tmp_path / "a.npz")
    assert not is_map_file(tmp_path / "a.npz")


def test_an_archive_that_points_before_its_beginning_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, **PAIR)
    content = bytearray(path.read_bytes())
    at = content.rindex(b"PK\x05\x06") + 12  # the size of the archive's table
    content[at : at + 4] = (int.from_bytes(content[at : at + 4], "little") + 40).to_bytes(4, "little")
    path.write_bytes(content)
    assert_refused(r"damaged", open_source, path)


def test_nan_points_need_no_color(tmp_path):
    whole = WHOLE.copy()
    whole[:3, [0, 4]] = np.nan
    assert "3 points with NaN" in read_cloud(save(tmp_path / "a.npy", whole)).warnings[0]


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (XYZ, r"an array \(1200, 3\) of type 'float64', wanted .npy of x y z r g b \(N, 6\)"),
        (np.hstack([WHOLE] * 11), r"an array \(1200, 66\)"),
        (WHOLE.astype(str), r"an array \(1200, 6\) of type '<U32'"),
        (np.zeros(1200, [("x", "f8")]), r"an array \(1200,\) of type"),
        (WHOLE + 400.0, r"point 1 has the colour .*, wanted 0 to 255"),
    ],
)
def test_other_arrays_are_refused(tmp_path, array, message):
    path = save(tmp_path / "a.npy", array)
    assert_refused(message, read_cloud, path, IN_COLORS)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points": XYZ, "c": RGB}, r"the arrays are 'points c', wanted"),
        ({"colors": RGB, "rgb": RGB}, r"the arrays are 'colors rgb'"),
        ({}, r"the arrays are ''|damaged|unknown format"),
        ({"points": XYZ, "colors": RGB[:-1]}, r"an array \(1200, 3\) of .* and an array \(1199, 3\)"),
        ({"points": XYZ, "colors": RGB / 200.0}, r"point \d+ has the colour .*, wanted 0 to 1"),
    ],
)
def test_other_archives_are_refused(tmp_path, arrays, message):
    path = tmp_path / "a.npz"
    np.savez(path, **arrays)
    assert_refused(message, read_cloud, path, IN_COLORS)


def test_nothing_is_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("unpickled",))

    objects = np.array([[Trap()] * 6] * 1000, dtype=object)
    np.save(tmp_path / "a.npy", objects, allow_pickle=True)
    np.savez(tmp_path / "a.npz", points=objects, colors=RGB)
    for name in ("a.npy", "a.npz"):
        assert_refused(r"an array \(1000, 6\) of type 'object'", read_cloud, tmp_path / name)


def npy_bytes(header, body=b""):
    header += " " * (-(len(header) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + body


def described(shape="(1200, 6)", descr="'<f8'", order="False"):
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}"


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (described("(10000000000000, 6)"), r"promises 480000000000000 bytes, found 57600; it is cut off"),
        (described("(1199, 6)"), r"promises 57552 bytes, found 57600"),
        (described("(-1200, 6)"), r"an array \(-1200, 6\) of type"),
        (described(f"({10**30}, 6)"), r"promises 48000"),
        (described("(True, 6)"), r"promises 48 bytes|damaged"),
        (described(descr="'|O'"), r"of type 'object'"),
        (described(descr="'|V0'"), r"an array|damaged"),
        (described(descr="[('x', '<f8', (1000000000, 1000000000))]"), r"damaged|promises"),
        (described(descr="5"), r"damaged"),
        ("(" * 3000, r"damaged"),
        ("-" * 3900 + "1", r"damaged"),
        ("{[]: 1}", r"damaged"),
        (described() + " " * 5000, r"damaged"),
    ],
)
def test_broken_headers_are_refused(tmp_path, header, message):
    content = npy_bytes(header, WHOLE.tobytes())
    (tmp_path / "a.npy").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("points.npy", content)
        archive.writestr("colors.npy", content)
    for name in ("a.npy", "a.npz"):
        assert_refused(message, read_cloud, tmp_path / name)


def test_other_versions_are_refused(tmp_path):
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x03\x00" + npy_bytes(described())[8:])
    assert_refused(r"an array of version 3.0, wanted 1.0 or 2.0", read_cloud, tmp_path / "a.npy")


def test_bombs_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, points=np.zeros((200_000, 3)), colors=np.zeros((200_000, 3)))
    assert_refused(r"promise 9600256 bytes, \d+ at most", read_cloud, path)
    np.savez_compressed(path, **PAIR)
    monkeypatch.setattr(npz, "MAX_UNPACKED", 30_000)
    assert_refused(r"promise 32656 bytes, 30000 at most", read_cloud, path)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_are_refused(tmp_path, method):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.writestr("points.npy", npy_bytes(described(), WHOLE.tobytes()))
        archive.writestr("colors.npy", npy_bytes(described(), WHOLE.tobytes()))
    assert_refused(r"'points.npy' is encrypted or compressed in another way", read_cloud, tmp_path / "a.npz")


@pytest.mark.parametrize("saver", SAVERS)
@pytest.mark.parametrize("order", ["C", "F"])
def test_a_flipped_byte_of_an_archive_is_found(tmp_path, saver, order):
    file = io.BytesIO()
    saver(file, points=np.asarray(XYZ, order=order), colors=RGB)
    content = bytearray(file.getvalue())
    content[len(content) // 2] ^= 1
    (tmp_path / "a.npz").write_bytes(content)
    assert_refused(r"damaged", read_cloud, tmp_path / "a.npz")


def test_a_damaged_map_is_still_a_map(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, format=np.array(FORMAT), sources=np.array("x"))
    content = path.read_bytes()
    for k in range(4, len(content), 3):
        path.write_bytes(content[:k] + bytes([content[k] ^ 0x55]) + content[k + 1 :])
        assert is_map_file(path)
    path.write_bytes(content[: len(content) // 2])
    assert is_map_file(path)
    assert_refused(r"wanted a whole map of tools/prepare_map.py", load_map, path)
