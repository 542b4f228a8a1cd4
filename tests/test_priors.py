"""What is known of each photo, by a table or by its GPS: what that says, and what is refused."""

import hashlib
import os
import struct
from dataclasses import replace

import numpy as np
import pytest
import rooms
from las_files import RAW, las_bytes, with_records
from pictures import write_photo
from pyproj import Transformer
from refusals import assert_input_error, assert_refused

import piccolo
from piccolo.batch.inputs import read_priors
from piccolo.cloud.cloud_settings import CloudSettings, from_wgs84
from piccolo.cloud.stream import read_crs
from piccolo.photo.panorama.facts import GpsPosition, PhotoFacts, read_photo_facts
from piccolo.photo.photo import Photo, Prior

TIER = "scene"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n1,2\n", "found the columns"),
        ("name,east\na,1\n", "found a column 'east'"),
        ("name,x,x\na,1,1\n", "found the columns"),
        ("name,x,y\na,1\n", "line 2: found x without y"),
        ("name,z\na,1\n", "line 2: found z without x"),
        ("name,tolerance\na,1\n", "line 2: found tolerance without heading"),
        ("name,gravity_x,gravity_z\na,0,-1\n", "line 2: found gravity_x without gravity_y"),
        ("name,gravity_x,gravity_y,gravity_z\na,0,-1,\n", "line 2: found gravity_y without gravity_z"),
        ("name,gravity_x,gravity_y,gravity_z\na,,0,-1\n", "line 2: found gravity_z without gravity_x"),
        ("name,gravity_x,gravity_y,gravity_z\na,0,0,0\n", "line 2: `gravity_vector`: found .*, not all 0"),
        ("name,heading\na,north\n", "line 2: found heading 'north', wanted a number"),
        ("name,heading\na,nan\n", "line 2: found heading nan, wanted a finite number"),
        ("name,x,y,radius\na,1,2,-3\n", "line 2: `radius`: found -3.0"),
        ("name,heading\na,1\na,2\n", "line 3: found the name 'a' twice"),
        ("name,heading\n ,1\n", "line 2: found no name"),
        ("name,heading\na,1,2\n", "line 2: found more cells than columns"),
        ("", "found the columns"),
    ],
)
def test_damaged_tables_are_refused_in_one_line(tmp_path, text, message):
    table = tmp_path / "priors.csv"
    table.write_text(text)
    assert_refused(message, read_priors, table, Prior())


def test_a_table_names_the_scans_that_a_photo_may_be_in(tmp_path):
    table = tmp_path / "priors.csv"
    table.write_text("name,within\na.jpg, Storey 1 ;Storey 2;\nb.jpg,\n")
    priors = read_priors(table, Prior(within=("Roof",)))
    assert priors.apply(Photo("a.jpg"), Prior(within=("Roof",)))[1].within == ("Storey 1", "Storey 2")
    assert priors.apply(Photo("b.jpg"), Prior(within=("Roof",)))[1].within == ("Roof",)


def test_a_table_gives_each_photo_its_gravity(tmp_path):
    table = tmp_path / "priors.csv"
    table.write_text("name,gravity_x,gravity_y,gravity_z,height\na.jpg,-4,0,-9,\nb.jpg,,,,1.5\n")
    priors = read_priors(table, Prior())
    photos = [Photo(name, gravity_vector=(0.0, 0.0, -1.0)) for name in ("a.jpg", "b.jpg")]
    found = [priors.apply(photo, Prior()) for photo in photos]
    assert [photo.gravity_vector for photo, _ in found] == [(-4.0, 0.0, -9.0), (0.0, 0.0, -1.0)]
    assert [prior.height for _, prior in found] == [None, (1.2, 1.8)]


def test_empty_cells_fall_back_and_paths_go_before_names(tmp_path):
    table = tmp_path / "priors.csv"
    table.write_text(f"name,x,y,z,heading,tolerance\na.jpg,1,2,3,90,\n{os.sep}b{os.sep}a.jpg,,,,10,5\n")
    priors = read_priors(table, Prior(heading_deg=0.0, heading_tolerance_deg=30.0))
    _, found = priors.apply(Photo("c/a.jpg"), Prior())
    assert found == Prior(near=(1.0, 2.0, 3.0), radius=5.0, heading_deg=90.0, heading_tolerance_deg=30.0)
    _, found = priors.apply(Photo("/b/a.jpg"), Prior())
    assert found == Prior(heading_deg=10.0, heading_tolerance_deg=5.0)


UTM = "EPSG:25832"
OFFSET = np.array([500_000.0, 5_400_000.0, 300.0])  # of a room in UTM


def test_a_photo_says_what_it_is_and_when_and_where_it_was_taken(tmp_path):
    rgb = rooms.query(1).rgb
    time = "2026:11:22 10:02:03", "25", "+01:00"
    path = write_photo(tmp_path / "a.jpg", rgb, (-48.5, 9.75), 4.0, time)
    photo = read_photo_facts(path)
    assert photo.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert photo.image_size == (rooms.WIDTH, rooms.WIDTH // 2)
    assert photo.capture_time == "2026-11-22T10:02:03.25+01:00"
    assert photo.gps == GpsPosition(pytest.approx(-48.5), pytest.approx(9.75), 4.0)
    bare = read_photo_facts(write_photo(tmp_path / "b.jpg", rgb, time=("soon", "", "")))
    assert (bare.capture_time, bare.gps) == (None, None)
    unset = read_photo_facts(write_photo(tmp_path / "d.jpg", rgb, time=("0000:00:00 00:00:00", "", "")))
    assert unset.capture_time is None
    assert read_photo_facts(write_photo(tmp_path / "c.jpg", rgb, (0.0, 0.0))).gps is None


def test_las_names_its_system(tmp_path):
    path = tmp_path / "a.las"
    for record_id, content, expected in (
        (2112, b'PROJCS["a",\n GEOGCS["b"]]\0', 'PROJCS["a", GEOGCS["b"]]'),
        (34735, struct.pack("<8H", 1, 1, 0, 1, 3072, 0, 1, 25832), UTM),
        (34735, struct.pack("<8H", 1, 1, 0, 1, 3072, 0, 1, 32767), ""),
        (34735, b"\1", ""),
        (7, b"else", ""),
    ):
        path.write_bytes(with_records(las_bytes(RAW), (record_id, content)))
        assert read_crs([path]) == expected
    other = tmp_path / "a.xyz"
    other.write_text("0 0 0 1 2 3\n")
    assert read_crs([other]) == ""


def test_a_position_becomes_a_prior_of_any_height():
    x, y = 512_345.0, 5_403_210.0
    longitude, latitude = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(x, y)
    reader = replace(rooms.scan(1), cloud_settings=CloudSettings(crs=UTM)).reader
    prior = reader.make_gps_prior(
        PhotoFacts("", (1, 1), None, GpsPosition(latitude, longitude, 4.0)), Prior()
    )
    assert prior.center_world == pytest.approx((x, y), abs=1e-3)
    assert (prior.radius, prior.is_used) == (15.0, True)
    rough = PhotoFacts("", (1, 1), None, GpsPosition(latitude, longitude, None))
    assert reader.make_gps_prior(rough, Prior()).radius == 30.0
    near = prior.apply_to(Prior(height=(1.0, 2.0)))
    assert near.near == (*prior.center_world, None)
    assert near.height == (1.0, 2.0)
    feet = "+proj=utm +zone=32 +datum=WGS84 +units=us-ft"  # the result is in metres in any case
    assert from_wgs84(feet, latitude, longitude) == pytest.approx((x, y), abs=1e-3)
    assert from_wgs84("EPSG:4326", latitude, longitude) is None
    assert_input_error("`crs`: found 'EPSG:0'", from_wgs84, "EPSG:0", latitude, longitude)
    assert_input_error("`crs`: found 'EPSG:0'", piccolo.Cloud, "no_such_scan.ply", crs="EPSG:0")


def test_a_photo_is_searched_about_its_position_and_then_anywhere(tmp_path):
    cloud = rooms.room(1)[1]
    taken = rooms.query(1)
    points = cloud.points + cloud.origin_world + OFFSET
    scan = piccolo.open_scan(piccolo.Cloud(points, colors=cloud.colors, crs=UTM))
    here = taken.pose.center_world + OFFSET
    to_degrees = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)
    for shift, is_used in ((3.0, True), (2000.0, False)):
        longitude, latitude = to_degrees.transform(here[0] + shift, here[1])
        path = write_photo(tmp_path / "a.jpg", taken.rgb, (latitude, longitude), 2.0)
        result = scan.localize(path)
        assert result.status == "localized"
        assert np.linalg.norm(result.pose.center_world - here) < 0.03
        assert result.gps_prior.is_used == is_used
        assert result.gps_prior.center_world == pytest.approx((here[0] + shift, here[1]), abs=0.01)
        assert piccolo.Result.from_json(result.to_json()).gps_prior == result.gps_prior
    assert scan.localize(path, prior=Prior(use_gps=False)).gps_prior is None
    near = tuple(here.tolist())
    assert scan.localize(path, prior=Prior(near=near, radius=2.0)).gps_prior is None
    assert rooms.scan(1).localize(path).gps_prior is None  # of no known coordinate system


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_tables_of_spreadsheets(tmp_path, encoding, delimiter):
    rows = [("Name", "X", "Y", "Radius"), ("a.jpg", "1,5", "-3,25", "2")]
    text = "\r\n".join(delimiter.join(row) for row in rows) + "\r\n"
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(encoding))
    prior, _ = read_priors(path, Prior()).by_name["a.jpg"]
    assert (prior.near, prior.radius) == ((1.5, -3.25, None), 2.0)
