"""PLY files as they are written: read back by our reader and by plyfile."""

import struct
from pathlib import Path

import numpy as np
import pytest
import rooms
from clouds import whole
from ply_files import RAW, RGB, vertices, write
from plyfile import PlyData, PlyElement
from refusals import assert_input_error, assert_refused
from scans import read_cloud

from piccolo.cloud.cloud_settings import IN_COLORS, CloudSettings
from piccolo.cloud.readers import ply
from piccolo.cloud.readers.ply import open_ply
from piccolo.cloud.stream import open_cloud
from piccolo.cloud.writers import coordinate_type, vertex_rows, writing_ply
from piccolo.system.errors import InputError

FACES = np.array([([0, 1, 2],), ([2, 3, 4],)], dtype=[("vertex_indices", "i4", (3,))])
TRIANGLES = PlyElement.describe(FACES, "strip")


def content_of(tmp_path, **options):
    return write(tmp_path / "whole.ply", vertices(), **options).read_bytes()


def assert_read_as_written(path, coordinate="f4"):
    read = whole(open_ply, path)
    assert read.points_world.dtype in (np.float64, coordinate)
    expected = RAW.points_world.astype(coordinate).astype(np.float64)
    # in ASCII a number may come back two roundings away
    np.testing.assert_allclose(read.points_world, expected, rtol=1e-15)
    np.testing.assert_array_equal(read.colors, RAW.colors)


@pytest.mark.parametrize("encoding", [{"byte_order": "<"}, {"byte_order": ">"}, {"text": True}])
@pytest.mark.parametrize(("color", "brightest"), [("u1", 255), ("u2", 65535), ("f4", 1), ("f8", 1)])
def test_encodings_and_color_types(tmp_path, encoding, color, brightest):
    path = write(tmp_path / "a.ply", vertices(color=color, brightest=brightest), **encoding)
    assert_read_as_written(path)


@pytest.mark.parametrize("names", [RGB, ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")])
def test_color_names_and_further_properties(tmp_path, names):
    assert_read_as_written(write(tmp_path / "a.ply", vertices(names=names, extra=("nx", "alpha"))))


@pytest.mark.parametrize("text", [False, True])
def test_other_elements_are_left_out(tmp_path, text):
    cameras = PlyElement.describe(np.ones(3, dtype=[("fx", "f4"), ("id", "u1")]), "camera")
    path = write(tmp_path / "a.ply", cameras, vertices(), TRIANGLES, text=text)
    assert_read_as_written(path)


@pytest.mark.parametrize("end", [b"\r\n", b"\r"])
def test_line_ends_and_foreign_comments(tmp_path, end):
    content = content_of(tmp_path, text=True, comments=["scan by Andre"])
    path = tmp_path / "a.ply"
    path.write_bytes(content.replace(b"Andre", "Andr\u00e9 element vertex 5".encode()).replace(b"\n", end))
    assert_read_as_written(path)


def test_content_comes_before_extension(tmp_path):
    path = write(tmp_path / "cloud with space.txt", vertices())
    np.testing.assert_array_equal(read_cloud(path).colors, read_cloud(path.rename(tmp_path / "b")).colors)


@pytest.mark.parametrize("brightness", [1.5, -0.1, np.nan])
def test_float_colors_out_of_range_are_refused(tmp_path, brightness):
    element = vertices(color="f4", brightest=1)
    element.data["green"][7] = brightness
    with pytest.raises(InputError, match=r"point 8 has the colour .*, wanted 0 to 1"):
        read_cloud(write(tmp_path / "a.ply", element))


@pytest.mark.parametrize("count", [1201, 10**9, 10**15 - 1])
@pytest.mark.parametrize("text", [False, True])
def test_promises_of_more_vertices_are_refused_before_memory_is_taken(tmp_path, text, count):
    path = tmp_path / "a.ply"
    content = content_of(tmp_path, text=text)
    path.write_bytes(content.replace(b"element vertex 1200", b"element vertex %d" % count))
    assert_refused(f"promises {count} vertices|found 1200 of {count} points", read_cloud, path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"plx\n", r"begins with b'plx\\n', wanted 'ply'"),
        (b"end_header", b"end_haeder", "the header has no line 'end_header'"),
        (b"ascii 1.0", b"ascii 9.0", "broken header .*expected version '1.0'"),
        (b"property float x", b"property flaot x", "broken header .*flaot"),
        (b"property float x", b"property float y", "broken header .*two properties with same name"),
        (
            b"property float x",
            b"property list uchar float x",
            "have no properties before a list, wanted",
        ),
        (b"element vertex 1200", b"element vertex -1", "the header counts '-1' elements"),
        (b"element vertex 1200", b"element points 1200", "no element 'vertex'"),
        (b"element vertex 1200", b"element vertex 0", "found 0 finite points"),
        (b"property float z", b"property float h", "vertices have x y h red green blue, wanted"),
        (b"end_header\n", b"end_header\n1 2 3 4 5 6 7\n", "line 11: 7 instead of 6 columns"),
        (b"end_header\n", b"end_header\n1 2 3 4 \x7f 5\n", r"line 11: '\\x7f' is not a number"),
        (b"end_header\n", b"end_header\n1 2 3 4 5 256\n", "point 1 has the colour 4 5 256, wanted"),
    ],
)
def test_broken_files_are_refused(tmp_path, old, new, message):
    path = tmp_path / "a.ply"
    path.write_bytes(content_of(tmp_path, text=True).replace(old, new, 1))
    assert_refused(message, read_cloud, path, IN_COLORS)


def with_lists(order):
    """A PLY file with faces before vertices that have lists; by hand, as plyfile errs."""
    rng = np.random.default_rng(4)
    names = {"<": "little", ">": "big"}
    lines = ["ply", f"format binary_{names[order]}_endian 1.0", "element face 2"]
    lines += ["property list uchar int vertex_indices", "element vertex 1200"]
    lines += [f"property float {name}" for name in "xyz"] + ["property list ushort uint views"]
    lines += [f"property uchar {name}" for name in RGB] + [
        "property list uchar float weights",
        "end_header",
        "",
    ]
    content = ["\n".join(lines).encode()] + [struct.pack(f"{order}B3i", 3, 0, 1, 2)] * 2
    for point, color in zip(RAW.points_world, RAW.colors, strict=True):
        views = rng.integers(0, 99, rng.integers(0, 5)).tolist()
        content.append(struct.pack(f"{order}3fH{len(views)}I", *point, len(views), *views))
        content.append(struct.pack(f"{order}3BB{len(views)}f", *color, len(views), *views))
    return b"".join(content)


@pytest.mark.parametrize("order", ["<", ">"])
def test_lists_before_and_in_the_vertices_are_passed_over(tmp_path, monkeypatch, order):
    expected = read_cloud(write(tmp_path / "a.ply", vertices()))
    path = tmp_path / "b.ply"
    path.write_bytes(with_lists(order))
    monkeypatch.setattr(ply, "MAX_VERTEX_SIZE", 256)
    read = read_cloud(path)
    np.testing.assert_array_equal(read.points, expected.points)
    np.testing.assert_array_equal(read.colors, expected.colors)
    path.write_bytes(path.read_bytes()[:-1])
    assert_refused("1 rows of 'vertex' are missing or broken", read_cloud, path)


def test_lists_in_text_are_passed_over_behind_the_colors(tmp_path):
    path = write(tmp_path / "a.ply", TRIANGLES, vertices(), text=True)
    expected = read_cloud(path)
    head, _, body = path.read_text().partition("end_header\n")
    rows = body.splitlines()
    rows = [*rows[:2], *(f"{row} {k % 3}" + " 7" * (k % 3) for k, row in enumerate(rows[2:]))]
    path.write_text(head + "property list uchar int views\nend_header\n" + "\n".join(rows) + "\n")
    np.testing.assert_array_equal(read_cloud(path).colors, expected.colors)


def test_a_list_that_promises_more_than_the_file_has_takes_no_memory(tmp_path):
    strip = np.array([(np.zeros(3, "u4"),)], [("l", object)])
    element = PlyElement.describe(strip, "strip", {"l": "u4"}, {"l": "u4"})
    path = write(tmp_path / "a.ply", element, vertices())
    content = path.read_bytes()
    place = content.index(b"end_header\n") + len(b"end_header\n")
    path.write_bytes(content[:place] + b"\xff" * 4 + content[place + 4 :])
    assert_refused("1 rows of 'strip' are missing or broken", read_cloud, path)


def test_opaque_gaussian_splats_are_read_in_their_constant_color(tmp_path):
    element = vertices(color="f4", brightest=1)
    names = (*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity")
    rows = np.empty(len(element.data), [(name, "f4") for name in names])
    for name in "xyz":
        rows[name] = element.data[name]
    for k, name in enumerate(("red", "green", "blue")):
        rows[f"f_dc_{k}"] = (element.data[name] - 0.5) / 0.28209479177387814
    rows["opacity"] = np.where(np.arange(len(rows)) < 1100, 2.0, -2.0)
    read = whole(open_ply, write(tmp_path / "a.ply", PlyElement.describe(rows, "vertex")))
    expected = whole(open_ply, write(tmp_path / "b.ply", vertices()))
    np.testing.assert_array_equal(read.colors, expected.colors[:1100])


def test_stray_faces_make_no_mesh_and_capitals_do_not_count(tmp_path):
    plain = vertices()
    capital = plain.data.astype([(name.upper(), type_) for name, type_ in plain.data.dtype.descr])
    expected = read_cloud(write(tmp_path / "a.ply", plain))
    faces = PlyElement.describe(FACES, "face")
    read = read_cloud(write(tmp_path / "b.ply", PlyElement.describe(capital, "vertex"), faces))
    np.testing.assert_array_equal(read.colors, expected.colors)
    assert any("2 faces left out" in warning for warning in read.warnings)


def test_paths_that_are_no_cloud_and_unreadable_files_are_refused(tmp_path, monkeypatch):
    (tmp_path / "empty.ply").touch()
    (tmp_path / "scan.doc").write_text("1 2 3 4 5 6")
    for name, message in [
        ("none.ply", "no such file"),
        (".", "not a file but a folder"),
        ("empty.ply", "the file is empty"),
        ("scan.doc", "unknown format '.doc', wanted a point cloud: PLY, .*text"),
    ]:
        assert_refused(message, read_cloud, tmp_path / name)

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    path = write(tmp_path / "a.ply", vertices())
    monkeypatch.setattr(Path, "open", refuse)  # file modes don't stop root, and tests may run as root
    assert_refused(r"a.ply: cannot be read \(Permission denied\)", read_cloud, path)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_scales_are_above_zero(scale):
    assert_input_error(r"`units`: found .*, wanted a number above 0", CloudSettings, scale)


def _cloud(num_points, dtype):
    rng = np.random.default_rng(2)
    points = (500_000.0 + rng.uniform(-9.0, 9.0, (num_points, 3))).astype(dtype)
    return points, rng.integers(0, 256, (num_points, 3), dtype=np.uint8), rng.integers(0, 99, num_points)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_cloud_comes_back(tmp_path, dtype):
    points, colors, labels = _cloud(1000, dtype)
    path = tmp_path / "a b.ply"
    rooms.write_ply(path, vertex_rows(points, colors, label=labels.astype(np.int32)))
    vertex = PlyData.read(path)["vertex"]
    assert [p.name for p in vertex.properties] == ["x", "y", "z", "red", "green", "blue", "label"]
    for k, name in enumerate("xyz"):
        assert vertex[name].dtype == dtype
        assert np.array_equal(vertex[name], points[:, k])
    assert np.array_equal(np.stack([vertex["red"], vertex["green"], vertex["blue"]], axis=1), colors)
    assert np.array_equal(vertex["label"], labels)
    chunks = list(open_cloud([path]).chunks([]))
    assert np.array_equal(np.concatenate([points_world for points_world, _ in chunks]), points)


def test_chunks_make_the_same_bytes_as_all_at_once(tmp_path):
    points, colors, _ = _cloud(1234, np.float32)
    rows = vertex_rows(points, colors)
    rooms.write_ply(tmp_path / "once.ply", rows)
    with writing_ply(tmp_path / "parts.ply") as writer:
        for begin in range(0, 1234, 100):
            writer.add(rows[begin : begin + 100])
    assert (tmp_path / "once.ply").read_bytes() == (tmp_path / "parts.ply").read_bytes()


def test_an_error_leaves_nothing(tmp_path):
    rows = vertex_rows(*_cloud(10, np.float32)[:2])
    with pytest.raises(AttributeError, match="dtype"), writing_ply(tmp_path / "a.ply") as writer:
        writer.add(rows.tolist())
    assert list(tmp_path.iterdir()) == []


def test_float32_is_kept_where_it_holds_a_tenth_of_a_millimetre():
    for size, is_double in ((500.0, False), (5000.0, True)):
        box = np.array([np.zeros(3), np.full(3, size)])
        assert (coordinate_type(box, np.eye(4), 1.0) == np.float64) == is_double
    assert coordinate_type(np.array([np.zeros(3), np.full(3, 500.0)]), np.eye(4), 0.001) == np.float32
