"""A scan put into a map: the poses of a map of both, and what it does not change keeps every bit."""

import functools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rooms
from refusals import assert_input_error
from scipy.spatial import cKDTree

from piccolo.cli import localize as localize_command, prepare_map as prepare_command
from piccolo.cloud.stream import CloudPoints
from piccolo.cloud.voxels import LEAF_SIZE, VoxelTable, join_voxels
from piccolo.geometry.pose import Pose
from piccolo.localization.place_names import add_places
from piccolo.localization.run import localize
from piccolo.photo.photo import Prior
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.scan_map.camera_positions import MIN_CLEARANCE
from piccolo.scan_map.map_file import load_map, save_map
from piccolo.scan_map.scan_addition import add_scan
from piccolo.scan_map.scan_map import find_scan_at, name_scan, prepare_map
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Stopwatch, Workers
from piccolo.views.candidate_views import SEARCH_VIEW, WideViews, render_wide

TIER = "scene"

BESIDE = np.array([5.3, 0.4, 0.2])  # of a second room, from where it was made [m]
WORKERS = Workers(2)


def _shifted(cloud, shift):
    """A cloud moved as a whole; the shift may be a fraction of a metre."""
    return CloudPoints(cloud.points, cloud.colors, cloud.origin_world + shift)


def _added(old, cloud, name):
    return add_scan(old, rooms.stream(cloud), name, WORKERS, Stopwatch())


@functools.lru_cache
def first():
    return name_scan(rooms.scan_map(1), "A")


@functools.lru_cache
def of_two_rooms():
    return _added(first(), _shifted(rooms.room(2)[1], BESIDE), "B")


def _localized(scan_map, seed, prior=None):
    settings = CoarseToFineSettings(gravity="known", prior=prior or Prior())
    panorama = rooms.as_panorama(rooms.query(seed).rgb)
    return add_places(scan_map, localize(scan_map, panorama, settings, rooms.means(settings, WORKERS)))


def _rows(scan_map, centers):
    """Of which candidates these are the places, and where there is none."""
    gap, rows = cKDTree(scan_map.centers).query(centers)
    return rows, gap > 0.0


def _wide_of(scan_map, candidates):
    """Wide views of some candidates that are searched."""
    place = {int(k): n for n, k in enumerate(scan_map.sparse)}
    rows = [place[int(k)] for k in candidates]
    return WideViews(scan_map.wide_features[rows], scan_map.wide_seen[rows])


def test_poses_are_those_of_a_map_of_both():
    a = rooms.room(1)[1]
    b = _shifted(rooms.room(2)[1], BESIDE)
    points = np.concatenate([a.points + a.origin_world, b.points + b.origin_world])
    both = CloudPoints(points, np.concatenate([a.colors, b.colors]), np.zeros(3))
    whole = prepare_map(rooms.stream(both), WORKERS)
    scan_map = of_two_rooms()
    assert abs(len(scan_map.centers) / len(whole.centers) - 1.0) < 0.05
    for seed, name, shift in ((1, "A", np.zeros(3)), (2, "B", BESIDE)):
        found, expected = _localized(scan_map, seed), _localized(whole, seed)
        assert (found.status, found.scan) == ("localized", name)
        assert expected.scan is None
        distance, angle = rooms.errors(found.pose, expected.pose)
        assert distance < 0.001
        assert angle < 0.02
        true = rooms.query(seed).pose
        assert rooms.errors(found.pose, Pose(true.R_cam_from_world, true.center_world + shift))[0] < 0.02


def test_what_the_new_scan_does_not_change_keeps_every_bit():
    """A room 40 m away, behind walls: nothing but views out of openings may change."""
    old = first()
    scan_map = _added(first(), _shifted(rooms.room(2)[1], np.array([40.0, 0.0, 0.0])), "B")
    rows, is_gone = _rows(scan_map, old.centers)
    assert not is_gone.any()
    np.testing.assert_array_equal(rows, np.arange(len(old.centers)))
    for name in ("centers", "scan_of_candidate"):
        np.testing.assert_array_equal(getattr(scan_map, name)[rows], getattr(old, name))
    for found, expected in zip(_wide_of(scan_map, rows[old.sparse]), _wide_of(old, old.sparse), strict=True):
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(scan_map.scan_of_candidate[len(rows) :], 1)
    leaves = old.octree.level(LEAF_SIZE)
    joined = scan_map.octree.level(LEAF_SIZE)
    assert set(map(bytes, leaves)) < set(map(bytes, joined))


def test_views_are_made_anew_where_the_new_scan_is_seen():
    """A column in the room: no candidate in it, and those around see it."""
    old = first()
    size = np.array([0.5, 0.5, 2.0])
    rng = np.random.default_rng(5)
    points = rng.uniform(-0.5, 0.5, (20_000, 3)) * size
    side = rng.integers(3, size=len(points))
    points[np.arange(len(points)), side] = (rng.integers(2, size=len(points)) - 0.5) * size[side]
    taken = old.from_world(rooms.query(1).pose).center_world  # within the room
    place = old.centers[np.linalg.norm(old.centers - taken, axis=1).argmin()]
    center_world = old.to_world(Pose(np.eye(3), place)).center_world
    colors = rng.integers(256, size=(len(points), 3), dtype=np.uint8)
    column = CloudPoints(points.astype(np.float32), colors, center_world)
    scan_map = _added(old, column, "column")
    gone = _rows(scan_map, old.centers)[1]
    beside = np.abs(old.centers - place) - size / 2
    inside = (beside < 0.0).all(axis=1)
    far = np.linalg.norm(np.maximum(beside, 0.0), axis=1) > 0.35
    assert gone[(np.abs(beside).min(axis=1) < MIN_CLEARANCE / 2) & inside].all()
    assert not gone[far].any()
    known = old.sparse[far[old.sparse]]
    rows, _ = _rows(scan_map, old.centers[known])
    views, before = _wide_of(scan_map, rows), _wide_of(old, known)
    changed = (views.features != before.features).any(axis=1)
    distance = np.linalg.norm(old.centers[known] - place, axis=1)
    assert changed[distance < 1.2].mean() > 0.8
    assert not changed.all()  # the column covers less than a hundredth, or is hidden
    anew = render_wide(scan_map.octree, scan_map.centers[rows[changed]], SEARCH_VIEW, WORKERS)
    for found, expected in zip(views, anew, strict=True):
        np.testing.assert_array_equal(found[changed], expected)
    everywhere = render_wide(scan_map.octree, scan_map.centers[scan_map.sparse], SEARCH_VIEW, WORKERS)
    like = (scan_map.wide_features == everywhere.features).mean(axis=1)
    assert like.min() > 0.5
    assert np.median(like) > 0.99
    assert find_scan_at(scan_map, old.centers[far][0]) == "A"


def test_within_tells_two_equal_rooms_apart():
    cloud = rooms.room(1)[1]
    shift = np.array([9.0, 0.0, 0.0])
    scan_map = _added(first(), _shifted(cloud, shift), "B")
    assert scan_map.scan_names == ("A", "B")
    either = _localized(scan_map, 1)
    assert either.status == "ambiguous"
    assert {either.scan, either.alternatives[0].scan} == {"A", "B"}
    true = rooms.query(1).pose
    for name, moved in (("A", 0.0 * shift), ("B", shift)):
        found = _localized(scan_map, 1, Prior(within=(name,)))
        assert (found.status, found.scan) == ("localized", name)
        assert rooms.errors(found.pose, Pose(true.R_cam_from_world, true.center_world + moved))[0] < 0.01


def test_joined_voxels_are_those_of_each_and_means_where_both_are():
    rng = np.random.default_rng(2)
    parts = [rng.uniform(0, 3, (4000, 3)), rng.uniform(1, 4, (4000, 3)) - [0, 0, 1]]
    tables = [VoxelTable("a"), VoxelTable("b")]
    for table, points in zip(tables, parts, strict=True):
        table.add(points, rng.integers(256, size=(4000, 3), dtype=np.uint8))
    a, b = (table.finish() for table in tables)
    moved = b.nodes.copy()
    moved[:, :3] += b.origin - a.origin
    joined = join_voxels(a.nodes, moved, a.origin)
    assert (np.diff(joined.codes) > 0).all()
    known = set(map(bytes, a.nodes)) | set(map(bytes, moved))
    is_own = np.array([bytes(node) in known for node in joined.nodes])
    num_shared = len(a.nodes) + len(b.nodes) - len(joined.nodes)
    assert np.count_nonzero(~is_own) == num_shared > 0
    np.testing.assert_array_equal(join_voxels(a.nodes, a.nodes, a.origin).nodes, a.nodes)
    np.testing.assert_array_equal(join_voxels(a.nodes, a.nodes[:0], a.origin).codes, a.codes)


def test_what_can_not_be_added_is_refused():
    cloud = rooms.room(2)[1]
    for name in ("", " A", "A\n", "x" * 101, "\x1b[31m"):
        with pytest.raises(InputError, match=r"^`name`: found .*, wanted 1 to 100 printable characters$"):
            name_scan(rooms.scan_map(1), name)
    with pytest.raises(InputError, match=r"^`name`: found 'A', which the map has already: 'A'$"):
        _added(first(), cloud, "A")
    with pytest.raises(InputError, match=r"^`add`: found a scan 30 km from the map's, wanted one coordinate"):
        _added(first(), _shifted(cloud, np.array([30_000.0, 0.0, 0.0])), "B")
    octree = first().octree._replace(leaf_size=0.04)
    with pytest.raises(InputError, match=r"^`add`: found a map of voxels of 0.04 m, wanted 0.02 m"):
        _added(replace(first(), octree=octree), cloud, "B")
    scan_map = _added(first(), _shifted(cloud, np.array([2000.0, 0.0, 0.0])), "B")
    assert "both need one coordinate system" in scan_map.warnings[-1]
    assert_input_error(r"^`name`: found a map of several scans: 'A', 'B'$", name_scan, scan_map, "C")


def test_a_map_of_two_scans_by_the_command_line(tmp_path, capsys):
    """Added in place; the result names the scan; a name that no scan has is one line."""
    elsewhere = rooms.scan_map(1).origin_world + np.array([0.0, 64.0, 0.0])  # 25 of the largest voxels
    save_map(replace(rooms.scan_map(1), origin_world=elsewhere), tmp_path / "house.map")
    path = str(tmp_path / "house.map")
    out = tmp_path / "out.json"
    room = rooms.write_room(tmp_path / "upper", "--seed 3 --points 30000 --panoramas 1 --width 512")
    cloud, pano = str(room / "cloud.ply"), str(room / "images" / "clean_0.jpg")
    assert prepare_command.main(["--cloud", cloud, "--add", cloud, "--out", path, "--quiet"]) == 3
    assert "found no prepared map" in capsys.readouterr().err
    missing = str(tmp_path / "missing.map")
    assert prepare_command.main(["--cloud", cloud, "--add", missing, "--out", str(out), "--quiet"]) == 3
    assert f"{missing}: found no such file, wanted a map of" in capsys.readouterr().err
    assert prepare_command.main(["--cloud", path, "--add", path, "--out", str(out), "--quiet"]) == 3
    assert "wanted the files of a scan to add" in capsys.readouterr().err
    add = ["--add", path, "--cloud", cloud, "--out", path, "--quiet"]
    assert prepare_command.main([*add, "--name", "house"]) == 3
    assert "--name: found 'house', which the map has already: 'house'" in capsys.readouterr().err
    assert prepare_command.main([*add, "--up", "x"]) == 3
    assert "a scan is added in the axes of the map" in capsys.readouterr().err
    assert prepare_command.main([*add, "--name", "Storey 2"]) == 0
    assert json.loads(capsys.readouterr().out)["scans"] == ["house", "Storey 2"]
    scan_map = load_map(tmp_path / "house.map")
    assert scan_map.scan_names == ("house", "Storey 2")
    query = ["--cloud", path, "--pano", pano, "--gravity", "known", "--out", str(out), "--overwrite"]
    assert localize_command.main([*query, "--within", "Storey 2"]) == 0
    found = json.loads(out.read_text())
    assert (found["scan"], found["settings"]["prior"]["within"]) == ("Storey 2", ["Storey 2"])
    assert "m (Storey 2) in" in capsys.readouterr().err
    assert localize_command.main([*query, "--within", "Storey 2", "Roof"]) == 3
    assert capsys.readouterr().err.endswith("--within: found 'Roof', wanted of 'house', 'Storey 2'\n")
    table = tmp_path / "priors.csv"
    table.write_text(f"name,within\n{Path(pano).name},house; Roof\n")
    assert localize_command.main([*query, "--priors", str(table)]) == 3
    wanted = f"{table}: within, of {Path(pano).name}: found 'Roof', wanted of 'house', 'Storey 2'\n"
    assert capsys.readouterr().err.endswith(wanted)
    assert localize_command.main(["--cloud", cloud, *query[2:], "--within", "Storey 2"]) == 3
    assert "--within: found a scan without names, wanted a map of" in capsys.readouterr().err
