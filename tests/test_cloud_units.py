"""The unit of a scan's coordinates: what its file says of it is taken, told, and overruled by `units`."""

import re
import struct
import sys

import numpy as np
import pytest
from clouds import seeded_cloud
from e57_files import ScanToWrite, write as write_e57
from las_files import OFFSETS, las_bytes, laz_bytes, with_records
from pyproj import CRS
from pyproj.enums import WktVersion
from refusals import assert_input_error
from scans import read_cloud

from piccolo.cloud.cloud_settings import BY_FILE, METRES, CloudSettings
from piccolo.cloud.stream import open_cloud, open_source
from piccolo.cloud.units import Units, units_of_geo_keys, units_of_wkt
from piccolo.cloud.writers import describe_unit, write_colored

FT = METRES["ft"]
US = METRES["us-ft"]
RAW = seeded_cloud(3, num_points=1500)
RAW = RAW._replace(points_world=RAW.points_world + OFFSETS)
DIALECTS = WktVersion.WKT1_GDAL, WktVersion.WKT1_ESRI, WktVersion.WKT2_2015, WktVersion.WKT2_2019
KEYS = 34735


def geo_keys(**values):
    """GeoTIFF keys with their values, by names k1024 and so on."""
    entries = [(int(name[1:]), 0, 1, value) for name, value in values.items()]
    return struct.pack("<4H", 1, 1, 0, len(entries)) + b"".join(struct.pack("<4H", *one) for one in entries)


def units_of(folder, *records, settings=BY_FILE):
    """What is decided of a LAS file: units and what is told."""
    path = folder / "a.las"
    path.write_bytes(with_records(las_bytes(RAW), *records))
    source = open_source(path, settings)
    return source.units, source.unit_note


@pytest.mark.parametrize("version", DIALECTS)
@pytest.mark.parametrize(
    ("system", "expected"),
    [
        ("EPSG:2263", (US, None)),
        ("EPSG:2263+6360", (US, US)),
        ("EPSG:26918+6360", (1.0, US)),
        ("EPSG:2263+5703", (US, 1.0)),
        ("EPSG:2222+8228", (FT, FT)),
        ("EPSG:25832", (1.0, None)),
        ("EPSG:25832+7837", (1.0, 1.0)),
    ],
)
def test_wkt_names_the_units_in_every_dialect(version, system, expected):
    assert units_of_wkt(CRS(system).to_wkt(version, pretty=True)) == Units(*expected)


def test_wkt_is_read_as_it_comes():
    assert units_of_wkt(CRS(4326).to_wkt()).is_degrees
    assert units_of_wkt(CRS(4979).to_wkt()).is_degrees
    assert units_of_wkt(CRS(4978).to_wkt()) == Units(1.0)
    assert units_of_wkt('LOCAL_CS["site",UNIT["foot",0.3048]]') == Units(FT)
    assert units_of_wkt(
        'ENGCRS["site",EDATUM["a"],CS[Cartesian,3],AXIS["x",east],LENGTHUNIT["mm",0.001]]'
    ) == (Units(0.001))
    three = "".join(f'AXIS["{name}",{way},LENGTHUNIT["u",{unit}]],' for name, way, unit in (
        ("x", "east", 1), ("y", "north", 1), ("z", "up", 0.3048)
    ))  # fmt: skip
    assert units_of_wkt(f'PROJCRS["a",CS[Cartesian,3],{three}ID["b",1]]') == Units(1.0, FT)
    bound = CRS(2263).to_wkt(WktVersion.WKT2_2019)
    wrapped = f'BOUNDCRS[SOURCECRS[{bound}],TARGETCRS[{CRS(4326).to_wkt()}],ABRIDGEDTRANSFORMATION["t"]]'
    assert units_of_wkt(wrapped) == Units(US)
    # round brackets, blanks, small letters, a quote in a name, a length with few digits
    assert units_of_wkt('projcs( "a ""UNIT[""b" ,\n unit ( "US foot" , 0.3048006 ) )') == Units(US)
    assert units_of_wkt('PROJCS["a",UNIT["Clarke",0.304797265]]').across == 0.304797265


@pytest.mark.parametrize(
    "text",
    ["", "EPSG:2263", "]]],,", "PROJCS[" * 20_000, "COMPD_CS[" * 20_000, 'PROJCS["a"]', 'PROJCS["a",UNIT[]]']
    + [f'PROJCS["a",UNIT["b",{number}]]' for number in ("0", "-1", "nan", "inf", "x", "1e999")],
)  # fmt: skip
def test_broken_wkt_names_no_unit(text):
    assert units_of_wkt(text) == Units()


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        (geo_keys(k1024=1, k3072=2263, k3076=9003, k4099=9003), Units(US, US)),
        (geo_keys(k1024=1, k3072=32767, k3076=9002), Units(FT)),
        (geo_keys(k3072=2263), Units(US)),
        (geo_keys(k3072=2263, k3076=9001), Units(1.0)),  # the key of the unit is the more particular one
        (geo_keys(k3072=26918, k4096=6360), Units(1.0, US)),
        (geo_keys(k3072=26918, k4099=9003), Units(1.0, US)),
        (geo_keys(k3072=26918, k4099=9999), Units(1.0)),
        (geo_keys(k3072=32767, k3076=9005), Units(0.3047972654)),
        (geo_keys(k3072=9999), Units(unknown="EPSG:9999")),
        (geo_keys(k1024=2, k2048=4326), Units(is_degrees=True)),
        (geo_keys(k2048=4326), Units(is_degrees=True)),
        (geo_keys(k1024=1, k2048=4269, k3072=26918), Units(1.0)),
        (geo_keys(k1024=1), Units()),
        (b"\1", Units()),
    ],
)
def test_geotiff_keys_name_the_units(keys, expected):
    assert units_of_geo_keys(keys, b"") == expected


def test_a_unit_may_be_given_by_its_length():
    keys = struct.pack("<12H", 1, 1, 0, 2, 3076, 0, 1, 32767, 3077, 34736, 1, 1)
    assert units_of_geo_keys(keys, struct.pack("<2d", 7.0, 0.3048006096)) == Units(US)
    assert units_of_geo_keys(keys, struct.pack("<2d", 7.0, -1.0)) == Units()
    assert units_of_geo_keys(keys, struct.pack("<d", 7.0)) == Units()


def test_las_is_read_in_the_units_that_it_names(tmp_path):
    wkt = CRS("EPSG:26918+6360").to_wkt(WktVersion.WKT1_GDAL).encode() + b"\0"
    units, note = units_of(tmp_path, (2112, wkt))
    words = "read in metres across and US survey feet up, as its coordinate system says; `units` overrules it"
    assert (units, note) == ((1.0, 1.0, US), words)
    path = tmp_path / "a.laz"
    path.write_bytes(laz_bytes((tmp_path / "a.las").read_bytes(), 500))
    cloud = read_cloud(path)
    assert cloud.warnings == (f"{path}: {note}",)
    plain = read_cloud(path, CloudSettings(scale=1.0))
    assert plain.warnings == ()
    for corner in (np.min, np.max):
        found, raw = (corner(one.points, axis=0) + one.origin_world for one in (cloud, plain))
        np.testing.assert_allclose(found, raw * [1.0, 1.0, US], atol=1e-3)
    assert units_of(tmp_path, (2112, wkt), settings=CloudSettings(scale=0.5)) == ((0.5,) * 3, "")


@pytest.mark.parametrize(
    ("records", "unit", "words"),
    [
        (
            [(KEYS, geo_keys(k3072=2263))],
            US,
            "read in US survey feet, as its coordinate system says of x and y;",
        ),
        (
            [(KEYS, geo_keys(k3072=9999))],
            1.0,
            r"it names EPSG:9999, whose unit is not known .*: read in metres;",
        ),
        ([(KEYS, geo_keys(k3072=25832))], 1.0, "$"),
        ([(2112, CRS("EPSG:25832").to_wkt().encode())], 1.0, "$"),
        ([], 1.0, "$"),
    ],
)
def test_what_is_not_metres_is_told(tmp_path, records, unit, words):
    units, note = units_of(tmp_path, *records)
    assert units == (unit,) * 3
    assert re.match(words, note)


def test_a_code_without_pyproj_is_told(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    units, note = units_of(tmp_path, (KEYS, geo_keys(k3072=2263)))
    assert (units, note.partition(";")[0]) == (
        (1.0,) * 3,
        "it names EPSG:2263, whose unit is not known (pyproj knows most: extra gps): read in metres",
    )
    assert units_of(tmp_path, (KEYS, geo_keys(k3072=2263, k3076=9003)))[0] == (US,) * 3


def test_degrees_are_refused_unless_the_scan_is_too_large_for_them(tmp_path):
    record = KEYS, geo_keys(k1024=2, k2048=4326)
    units, note = units_of(tmp_path, record)  # UTM under a wrong name
    assert units == (1.0,) * 3
    assert re.match(r"its coordinate system is in degrees, but it spans \d+ x \d+: read in metres;", note)
    path = tmp_path / "b.las"
    content = bytearray(with_records(las_bytes(RAW), record))
    struct.pack_into("<4d", content, 179, -73.9, -73.91, 40.71, 40.7)
    path.write_bytes(content)
    message = f"^{re.escape(str(path))}: found degrees of longitude and latitude, wanted metres or feet"
    assert_input_error(message, open_source, path)
    assert open_source(path, CloudSettings(scale=1.0)).units == (1.0,) * 3


def test_files_of_one_unit_are_told_of_once_and_each_is_read_in_its_own(tmp_path):
    for name in "abc":
        (tmp_path / f"{name}.las").write_bytes(with_records(las_bytes(RAW), (KEYS, geo_keys(k3076=9003))))
    (tmp_path / "d.las").write_bytes(las_bytes(RAW))
    paths = sorted(tmp_path.iterdir())
    cloud = open_cloud(paths)
    assert (cloud.scale, open_cloud(paths[:3]).scale) == (1.0, US)
    low = RAW.points_world.min(axis=0)
    high = RAW.points_world.max(axis=0)
    (told,) = [line for line in cloud.voxels(np.eye(3)).warnings if "US survey" in line]
    assert told.startswith(f"{paths[0]} and 2 more: read in US survey feet, as")
    ends = np.minimum(low, low * US), np.maximum(high, high * US)
    np.testing.assert_allclose(cloud.box, ends, atol=2e-3)


def test_e57_is_in_metres_whatever_its_system_says(tmp_path):
    rgb = dict(zip(("colorRed", "colorGreen", "colorBlue"), RAW.colors.T.astype(np.int64), strict=True))
    xyz = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), RAW.points_world.T, strict=True))
    scan = ScanToWrite({**xyz, **rgb}, dict.fromkeys(rgb, (0, 255)))
    for system, words in (
        ("EPSG:2263", "its coordinate system is in US survey feet, but E57 is in metres"),
        (25832, ""),
    ):
        source = open_source(write_e57(tmp_path / "a.e57", [scan], crs=CRS(system).to_wkt()))
        assert source.units == (1.0,) * 3
        assert source.unit_note.startswith(words)
        assert bool(source.unit_note) == bool(words)
    feet = open_source(tmp_path / "a.e57", CloudSettings(scale=US))
    assert (feet.units, feet.unit_note) == ((US,) * 3, "")


@pytest.mark.parametrize(
    ("keys", "scale", "crs", "name", "is_told"),
    [
        (geo_keys(k3072=2263, k4099=9003), US, "EPSG:2263", "out.las", False),
        (geo_keys(k3072=2263, k4099=9003), US, "EPSG:2263", "out.ply", True),
        (geo_keys(k3072=26918, k4099=9003), 1.0, "EPSG:26918", "out.las", False),
    ],
)
def test_a_coloured_copy_is_read_as_the_scan_was(tmp_path, keys, scale, crs, name, is_told):
    (tmp_path / "a.las").write_bytes(with_records(las_bytes(RAW), (KEYS, keys)))
    cloud = open_cloud([tmp_path / "a.las"])
    assert cloud.scale == scale
    expected = cloud.read()
    out = tmp_path / name

    def paint(points):
        return np.full(points.shape, (200, 0, 0), np.uint8), np.ones(len(points), np.uint8)

    write_colored(cloud, paint, cloud.box, out, crs)
    told = describe_unit(cloud, out, crs)
    line = f"{out}: written in the unit of the scan, which it does not say; read it with `units` us-ft"
    assert told == ((line,) if is_told else ())
    found = read_cloud(out, CloudSettings(scale=US if is_told else None))
    for corner in (np.min, np.max):
        ends = [corner(one.points, axis=0) + one.origin_world for one in (found, expected)]
        np.testing.assert_allclose(*ends, atol=2e-3)
