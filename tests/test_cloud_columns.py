"""Columns of lines without a header: by the values of all, or by the user."""

import numpy as np
import pytest
from clouds import whole

from piccolo.cloud.cloud_settings import CloudSettings
from piccolo.cloud.readers.text_columns import name_columns
from piccolo.cloud.stream import open_source
from piccolo.system.errors import InputError

RNG = np.random.default_rng(3)
NUM = 1500
XYZ = np.round(RNG.uniform(-40.0, 40.0, (NUM, 3)), 4)
GRAY = RNG.integers(20, 236, (NUM, 1))
RGB = GRAY + RNG.integers(-20, 20, (NUM, 3))  # as colours are: near to gray
NORMALS = RNG.normal(size=(NUM, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
INTENSITIES = {
    "fraction": np.round(RNG.random(NUM), 4),
    "byte": RNG.integers(0, 256, NUM),
    "signed": RNG.integers(-2048, 2048, NUM),
    "of 16 bits": RNG.integers(0, 65536, NUM),
    "mean": GRAY[:, 0],
    "constant": np.zeros(NUM),
}
CLASS = RNG.integers(0, 9, NUM)
ROW = np.arange(NUM) // 40
COLUMN = np.arange(NUM) % 40
PACKED = RGB @ [1 << 16, 1 << 8, 1]


def write(path, *columns, separator=" "):
    table = np.column_stack(columns)
    is_whole = np.all(table % 1.0 == 0.0, axis=0)
    np.savetxt(path, table, fmt=["%d" if some else "%.6f" for some in is_whole], delimiter=separator)
    return path


def assert_read(path, settings=None, num_warnings=1):
    source = open_source(path) if settings is None else open_source(path, settings)
    parts = list(source.read_chunks())
    np.testing.assert_allclose(np.vstack([p.points_world for p in parts]), XYZ, atol=1e-9)
    np.testing.assert_array_equal(np.vstack([p.colors for p in parts]), RGB)
    assert len(source.warnings) == num_warnings, source.warnings


@pytest.mark.parametrize("suffix", ["txt", "pts", "xyz", "csv"])
@pytest.mark.parametrize("kind", INTENSITIES)
def test_an_intensity_before_the_colors(tmp_path, suffix, kind):
    path = write(tmp_path / f"a.{suffix}", XYZ, INTENSITIES[kind], RGB)
    assert_read(path, num_warnings=suffix != "pts")


@pytest.mark.parametrize("kind", [kind for kind in INTENSITIES if kind != "mean"])
def test_an_intensity_behind_the_colors(tmp_path, kind):
    assert_read(write(tmp_path / "a.txt", XYZ, RGB, INTENSITIES[kind]))


@pytest.mark.parametrize(
    "columns",
    [
        (ROW, COLUMN, XYZ, RGB),
        (ROW, COLUMN, XYZ, INTENSITIES["fraction"], RGB),
        (XYZ, RGB, NORMALS),
        (XYZ, NORMALS, RGB),
        (XYZ, INTENSITIES["byte"], RGB, NORMALS),
        (XYZ, INTENSITIES["of 16 bits"], RGB, CLASS),
        (XYZ, RGB, CLASS, CLASS + 3),
        (XYZ, PACKED),
    ],
    ids=[
        "faro",
        "faro_intensity",
        "metashape",
        "normals",
        "intensity_normals",
        "semantic",
        "labels",
        "packed",
    ],
)
def test_relatives_are_told_by_their_values(tmp_path, columns):
    path = write(tmp_path / "a.txt", *columns)
    assert_read(path)
    assert "columns read as" in open_source(path).warnings[0]


def test_colors_as_fractions_and_normals_alone(tmp_path):
    path = write(tmp_path / "a.xyz", XYZ, INTENSITIES["signed"], RGB / 255.0)
    np.testing.assert_array_equal(whole(open_source, path).colors, RGB)
    assert open_source(write(tmp_path / "b.xyz", XYZ, NORMALS)).channel == "shape"


def test_the_user_names_columns(tmp_path):
    path = write(tmp_path / "a.txt", CLASS, RGB, XYZ, INTENSITIES["byte"])
    assert_read(path, CloudSettings(columns=("-", "r", "g", "b", "x", "y", "z", "i")), num_warnings=0)
    read = whole(open_source, path, CloudSettings(columns=tuple("-rgbxyzi"), channels=("intensity",)))
    assert len(np.unique(read.colors)) > 100
    np.save(tmp_path / "a.npy", np.column_stack([RGB, XYZ]))
    assert_read(tmp_path / "a.npy", CloudSettings(columns=tuple("rgbxyz")), num_warnings=0)
    with pytest.raises(InputError, match=r"`columns`: found 9 names, but 8 columns"):
        open_source(path, CloudSettings(columns=tuple("xyzrgb---")))
    with pytest.raises(InputError, match=r"`columns`: found 'x,y,r', wanted x, y, z among them"):
        CloudSettings(columns=("x", "y", "r"))
    np.savez(tmp_path / "a.npz", points=XYZ, colors=RGB)
    with pytest.raises(InputError, match=r"names its columns; `columns` is for PTS, NumPy \.npy, text"):
        open_source(tmp_path / "a.npz", CloudSettings(columns=tuple("xyzrgb")))


@pytest.mark.parametrize("order", ["rgbi", "irgb"])
def test_arrays_of_more_columns(tmp_path, order):
    columns = {"irgb": (XYZ, INTENSITIES["byte"], RGB), "rgbi": (XYZ, RGB, INTENSITIES["byte"])}[order]
    np.save(tmp_path / "a.npy", np.column_stack(columns))
    assert_read(tmp_path / "a.npy")


def test_few_or_no_rows_name_columns():
    assert name_columns(np.empty((0, 6))) == ("x", "y", "z", "red", "green", "blue")
    assert name_columns(np.full((3, 7), np.nan)) == ("x", "y", "z", "-", "-", "-", "-")
    assert name_columns(np.zeros((2, 6)))[3:] == ("red", "green", "blue")


@pytest.mark.parametrize("separator", [";", "; ", " ", "\t"])
@pytest.mark.parametrize("header", ["", "X;Y;Z;R;G;B\n"])
def test_decimal_commas(tmp_path, separator, header):
    path = write(tmp_path / "a.csv", XYZ, RGB, separator=separator)
    path.write_text(header.replace(";", separator) + path.read_text().replace(".", ","))
    assert_read(path, num_warnings=0)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_utf_16(tmp_path, encoding):
    path = write(tmp_path / "a.txt", XYZ, RGB)
    mark = "" if encoding == "utf-16" else "\ufeff"
    path.write_bytes((mark + "X Y Z R G B\n" + path.read_text()).encode(encoding))
    assert_read(path, num_warnings=0)
    path.write_bytes(path.read_bytes()[:-100] + b"\xd8" * 40)
    with pytest.raises(InputError, match="line 1"):
        whole(open_source, path)


@pytest.mark.parametrize(
    ("line", "header", "num_warnings"),
    [
        ("{x:.4f} {y:.4f} {z:.4f} #{r:02x}{g:02x}{b:02x}", "", 1),
        ("{x:.4f},{y:.4f},{z:.4f},0x{r:02X}{g:02X}{b:02X}", "X,Y,Z,Color", 0),
        ('"{x:.4f}","{y:.4f}","{z:.4f}","{r}","{g}","{b}"', '"x","y","z","r","g","b"', 0),
        ("[{x:.4f}, {y:.4f}, {z:.4f}, {r}, {g}, {b}]", "", 0),
        ("{k},{x:.4f},{y:.4f},{z:.4f},{r},{g},{b}", ",x,y,z,r,g,b", 0),
        ("{k}\t{x:.4f}\t{y:.4f}\t{z:.4f}\t{r}\t{g}\t{b}", "", 1),
    ],
)
def test_other_spellings_of_numbers_and_an_index_in_front(tmp_path, line, header, num_warnings):
    rows = [
        line.format(k=k, x=p[0], y=p[1], z=p[2], r=c[0], g=c[1], b=c[2])
        for k, (p, c) in enumerate(zip(XYZ.tolist(), RGB.tolist(), strict=True))
    ]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([header, *rows, ""]))
    assert_read(path, num_warnings=num_warnings)
