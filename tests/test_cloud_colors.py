"""The range of colours: one rule for all formats, and one option that overrules it."""

import itertools

import numpy as np
import pytest
from clouds import seeded_cloud, whole
from plyfile import PlyData, PlyElement
from refusals import assert_refused
from scans import read_cloud

from piccolo.cloud.cloud_settings import IN_COLORS, CloudSettings
from piccolo.cloud.stream import open_source, stream_of_arrays
from piccolo.system.errors import InputError

RAW = seeded_cloud(5, num_points=1500)
RGB = ("red", "green", "blue")


def _write_ply(path, colors, text=False):
    fields = [*((name, "f8") for name in "xyz"), *((name, colors.dtype.str) for name in RGB)]
    rows = np.empty(len(colors), fields)
    for k in range(3):
        rows["xyz"[k]] = RAW.points_world[:, k]
        rows[RGB[k]] = colors[:, k]
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(str(path))


def _write_pcd(path, colors):
    fields = [("xyz", "3<f8"), ("rgb", f"3{colors.dtype.str}")]
    rows = np.empty(len(colors), fields)
    rows["xyz"] = RAW.points_world
    rows["rgb"] = colors
    size = colors.itemsize
    kind = colors.dtype.kind.upper()
    header = f"VERSION 0.7\nFIELDS x y z r g b\nSIZE 8 8 8 {size} {size} {size}\n"
    header += f"TYPE F F F {kind} {kind} {kind}\nCOUNT 1 1 1 1 1 1\nPOINTS {len(rows)}\nDATA binary\n"
    path.write_bytes(header.encode() + rows.tobytes())


def _write_text(path, colors):
    table = np.hstack([RAW.points_world, colors])
    np.savetxt(path, table, fmt="%.9f" if colors.dtype.kind == "f" else ["%.9f"] * 3 + ["%d"] * 3)


WRITERS = {
    "a.ply": _write_ply,
    "b.ply": lambda path, colors: _write_ply(path, colors, text=True),
    "a.pcd": _write_pcd,
    "a.npz": lambda path, colors: np.savez(path, points=RAW.points_world, colors=colors),
    "a.npy": lambda path, colors: np.save(path, np.hstack([RAW.points_world, colors])),
    "a.txt": _write_text,
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize(
    ("type_", "brightest"),
    [*itertools.product(["u2", "i4", "f4", "f8"], [255, 65535]), ("f4", 1), ("f8", 1)],
)
def test_one_rule_for_all_formats(tmp_path, name, type_, brightest):
    colors = (RAW.colors * (brightest / 255)).astype(type_)
    WRITERS[name](tmp_path / name, colors)
    source = open_source(tmp_path / name)
    assert np.abs(whole(open_source, tmp_path / name).colors.astype(int) - RAW.colors).max() <= 1
    has_type = name not in ("a.npy", "a.txt")
    usual = {"u2": 65535, "f4": 1, "f8": 1}.get(type_, 255) if has_type else 255
    warned = [f"colours are read as 0 to {brightest} instead of 0 to {usual}"] * (brightest != usual)
    assert [warning.split(": ")[1].split(" (")[0] for warning in source.warnings] == warned


@pytest.mark.parametrize("name", WRITERS)
def test_the_option_overrules_the_rule(tmp_path, name):
    WRITERS[name](tmp_path / name, RAW.colors.astype("f4"))
    settings = CloudSettings(color_range=65535.0)
    dark = whole(open_source, tmp_path / name, settings)
    np.testing.assert_array_equal(dark.colors, np.rint(RAW.colors / 257.0))
    assert open_source(tmp_path / name, settings).warnings == ()
    with pytest.raises(InputError, match=r"has the colour .*, wanted 0 to 1, or `color_range`"):
        whole(open_source, tmp_path / name, CloudSettings(color_range=1.0))


def test_a_dark_beginning_decides_nothing(tmp_path):
    colors = np.full((1500, 3), 0.0)
    colors[1400:] = 1.0
    colors[-1] = 200.0, 100.0, 50.0
    _write_text(tmp_path / "a.xyzrgb", colors)
    source = open_source(tmp_path / "a.xyzrgb")
    assert "read as 0 to 255 instead of 0 to 1" in source.warnings[0]
    assert read_cloud(tmp_path / "a.xyzrgb").colors.max() == 200


def test_names_and_suffixes_declare_fractions(tmp_path):
    _write_text(tmp_path / "a.xyzrgb", RAW.colors / 255.0)
    _write_text(tmp_path / "a.txt", RAW.colors / 255.0)
    named = tmp_path / "b.txt"
    named.write_text("//X Y Z Rf Gf Bf\n" + (tmp_path / "a.txt").read_text())
    assert [len(open_source(path).warnings) for path in (tmp_path / "a.xyzrgb", named)] == [0, 0]
    for path in (tmp_path / "a.xyzrgb", named):
        np.testing.assert_array_equal(whole(open_source, path).colors, RAW.colors)


def test_black_is_refused_and_one_color_for_all_points_is_told(tmp_path):
    _write_ply(tmp_path / "a.ply", np.zeros((1500, 3), np.uint8))
    assert_refused("all points are black .*, wanted their colours", read_cloud, tmp_path / "a.ply", IN_COLORS)
    _write_ply(tmp_path / "a.ply", np.full((1500, 3), 90, np.uint8))
    (warning,) = read_cloud(tmp_path / "a.ply").warnings
    assert "all points have one colour (90 90 90)" in warning


def test_arrays_follow_the_rule():
    for scale, type_ in ((1.0, "u1"), (1.0, "i8"), (257.0, "u2"), (1 / 255, "f8"), (1.0, "f4"), (1.0, "u2")):
        given = (RAW.colors * scale).astype(type_)
        read = stream_of_arrays(RAW.points_world, given).read()
        expected = stream_of_arrays(RAW.points_world, RAW.colors).read()
        np.testing.assert_array_equal(read.colors, expected.colors)


def test_settings_refuse_other_ranges():
    with pytest.raises(InputError, match=r"`color_range`: found 100.0, wanted 1, 255 or 65535"):
        CloudSettings(color_range=100.0)
