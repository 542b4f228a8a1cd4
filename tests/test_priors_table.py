"""Tables of what is known of each photo: what they say, and what is refused."""

import os

import pytest
from refusals import assert_refused

from piccolo.batch.priors import read_priors
from piccolo.photo import Photo
from piccolo.prior import Prior


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
    found = [
        priors.apply(Photo(name, gravity_vector=(0.0, 0.0, -1.0)), Prior()) for name in ("a.jpg", "b.jpg")
    ]
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
