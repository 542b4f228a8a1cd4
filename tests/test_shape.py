"""Scans without colours: edges of surfaces and of photos, the tilt by lines, and photos found by both."""

import functools
import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import e57_files
import numpy as np
import pytest
import rooms
from las_files import OFFSETS, las_bytes
from made_up import PROBLEM, make_candidate, make_selection
from meshes import SQUARE, write_obj
from refusals import assert_input_error
from scans import read_cloud

import piccolo
from piccolo.cli import localize as command_line
from piccolo.cloud.cloud_settings import IN_COLORS, WITHOUT_COLORS, CloudSettings
from piccolo.cloud.octree import build_octree
from piccolo.cloud.readers.reader import RawCloud
from piccolo.cloud.stream import open_cloud, stream_of_arrays
from piccolo.cloud.surfaces import paint_shape
from piccolo.evidence.examine import complete, examine
from piccolo.geometry.pose import angle_between, exp_so3
from piccolo.geometry.sphere import compute_indices, pixel_rays
from piccolo.judge.probability import log_odds
from piccolo.judge.selection import assess_alone
from piccolo.localization import run as method
from piccolo.localization.shape import align_lines
from piccolo.photo.panorama import Panorama
from piccolo.photo.panorama.edges import draw_edges, find_axes, soften
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.scan_map.map_file import load_map, save_map
from piccolo.scan_map.scan_map import SHAPE_ALONE, prepare_map
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Workers
from research.synthetic.places import make_alike
from research.synthetic.world import World, make_query, scan_world

TIER = "scene"

WIDTH = 1024
SEED = 6  # of a room whose walls are plain: strong patterns hide its edges
NUM_POINTS = 200_000
PATTERNED = 12  # of a room with patterns on its walls
LEVEL = np.eye(3)
RACKS = 102  # of a store of racks
AISLE = 2.4  # [m] between two of them
BAY = 1.6  # [m] of a rack
TILTED = exp_so3(np.array([0.5, 0.3, 0.2]))


def _opponent(rgb):
    """Strength of edges, and of vertical ones less others, each about in [0, 1] and [-1, 1]."""
    r, g, b = np.moveaxis(rgb.astype(float) / 255.0, -1, 0)
    return (2.0 * g - r - b) / 4.0 / 0.3 + 0.5, (r - b) / 2.0 / 0.15


def _in_gray(cloud):
    return replace(cloud, colors=np.full_like(cloud.colors, 128), has_colors=False)


@functools.lru_cache
def _shape_map():
    made = prepare_map(rooms.stream(_in_gray(rooms.room(SEED, NUM_POINTS)[1])), Workers(2))
    return replace(made, scan_sha256=64 * "0")


def _turned(rgb, R_new_from_old):
    """A panorama as a camera turned by a rotation takes it."""
    indices = compute_indices(pixel_rays(rgb.shape[1]) @ R_new_from_old, rgb.shape[1])
    return Panorama(rgb[indices], np.ones(indices[0].shape, bool))


def _plane(axis, offset, low, high, step=0.015):
    """Points (N, 3) of a part of a plane across an axis."""
    a, b = np.meshgrid(np.arange(low, high, step), np.arange(low, high, step))
    points = np.insert(np.stack([a.ravel(), b.ravel()], axis=1), axis, offset, axis=1)
    return points + np.random.default_rng(axis).normal(0.0, 0.001, points.shape)


@functools.lru_cache
def _painted():
    """A corner of walls and floor, and a plate: positions, strength of edges, vertical less others."""
    plate = _plane(1, 4.0, 1.4, 2.2)
    corner = [_plane(0, 0.0, 0.0, 3.0), _plane(1, 0.0, 0.0, 3.0), _plane(2, 0.0, 0.0, 3.0)]
    points = np.concatenate([*corner, plate]).astype(np.float32)
    voxels = rooms.voxels(points)
    leaves = paint_shape(build_octree(voxels), Workers(2)).level(0.04)
    return leaves[:, :3] + voxels.origin, *_opponent(leaves[:, 3:] * 255.0)


def _near(points, low, high):
    return np.all((points > low) & (points < high), axis=1)


def test_creases_are_painted_and_planes_are_not():
    points, strength, vertical = _painted()
    inner = _near(points, (-0.1, 0.5, 0.5), (0.1, 2.5, 2.5))
    upright = _near(points, (-0.03, -0.03, 0.5), (0.03, 0.03, 2.5))
    lying = _near(points, (-0.03, 0.5, -0.03), (0.03, 2.5, 0.03))
    assert min(inner.sum(), upright.sum(), lying.sum()) >= 50
    assert np.median(strength[inner]) < 0.1
    assert np.median(strength[upright]) > 0.7
    assert np.median(strength[lying]) > 0.7
    assert np.median(vertical[upright]) > 0.5
    assert np.median(vertical[lying]) < -0.5


def test_borders_of_surfaces_are_painted():
    points, strength, vertical = _painted()
    middle = _near(points, (1.65, 3.9, 1.65), (1.95, 4.1, 1.95))
    side = _near(points, (1.38, 3.9, 1.6), (1.44, 4.1, 2.0))
    below = _near(points, (1.6, 3.9, 1.38), (2.0, 4.1, 1.44))
    assert np.median(strength[middle]) < 0.1
    for edge, sign in ((side, 1.0), (below, -1.0)):
        assert np.median(strength[edge]) > 0.5
        assert np.median(sign * vertical[edge]) > 0.4


def test_the_same_bits_with_any_number_of_threads():
    octree = rooms.scan_map(1).octree
    one, two = (paint_shape(octree, Workers(count)) for count in (1, 2))
    np.testing.assert_array_equal(one.nodes, two.nodes)
    np.testing.assert_array_equal(one.nodes[:, :3], octree.nodes[:, :3])


@pytest.mark.parametrize("R_cam_from_level", [LEVEL, TILTED])
def test_edges_of_a_photo_are_told_by_their_direction(R_cam_from_level):
    """Before a bright square on a wall ahead, seen by a camera of known tilt."""
    rays = pixel_rays(2 * WIDTH) @ R_cam_from_level
    x, y, z = np.moveaxis(rays, -1, 0)
    is_bright = (x > 0.0) & (np.abs(y) < 0.4 * x) & (np.abs(z) < 0.3 * x)
    rgb = np.where(is_bright[..., None], np.uint8(200), np.uint8(60)).repeat(3, axis=2)
    drawn = draw_edges(Panorama(rgb, np.ones(rgb.shape[:2], bool)), R_cam_from_level, has_gray=False)
    assert drawn.rgb.shape == (WIDTH // 2, WIDTH, 3)
    strength, vertical = _opponent(drawn.rgb)

    def at(x, y, z):
        return compute_indices(R_cam_from_level @ np.array([x, y, z]), WIDTH)

    side, top, inside = at(1.0, 0.4, 0.05), at(1.0, 0.05, 0.3), at(1.0, 0.1, 0.1)
    assert min(strength[side], strength[top]) > 0.4
    assert abs(strength[inside]) < 0.03
    assert vertical[side] > 0.3
    assert vertical[top] < -0.3


def test_masked_pixels_have_no_edges_and_stay_masked():
    rgb = rooms.query(1, width=WIDTH).rgb.copy()
    is_valid = np.ones(rgb.shape[:2], bool)
    is_valid[:, 300:500] = False
    other = rgb.copy()
    other[:, 302:498] = 255
    one, two = (draw_edges(Panorama(picture, is_valid), LEVEL, has_gray=False) for picture in (rgb, other))
    np.testing.assert_array_equal(one.is_valid, is_valid)
    np.testing.assert_array_equal(one.rgb[is_valid], two.rgb[is_valid])


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.4, -0.3, 1.0), (1.5, 0.2, 0.0), (2.9, 0.3, 0.0)])
def test_the_vertical_is_among_the_axes_of_a_photos_lines(turn):
    R = exp_so3(np.array(turn))
    axes = np.array(find_axes(_turned(rooms.query(1, width=WIDTH).rgb, R)))
    assert len(axes) == 6
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)
    assert np.degrees(np.arccos((axes @ R[:, 2]).max())) < 4.0
    assert (np.diff(axes[:, 2]) <= 1e-12).all()
    nothing = np.zeros((64, 128), bool)
    assert find_axes(Panorama(np.zeros((64, 128, 3), np.uint8), nothing)) == []


@pytest.mark.parametrize(("gravity", "R"), [("known", LEVEL), ("auto", LEVEL), ("auto", TILTED)])
def test_a_photo_is_found_by_shape(gravity, R):
    taken = rooms.query(SEED, width=WIDTH)
    settings = CoarseToFineSettings(gravity=gravity)
    found = rooms.locate(_turned(taken.rgb, R), _shape_map(), settings)
    true_pose = replace(taken.pose, R_cam_from_world=R @ taken.pose.R_cam_from_world)
    rooms.assert_near(found.pose, true_pose, 0.1, 4.0)
    assert found.evidence.num_matches is None
    assert all(standing.evidence == "shape" for standing in found.standings)


def test_intensity_is_a_channel_of_its_own():
    cloud = rooms.room(PATTERNED, NUM_POINTS // 2)[1]
    gray = np.repeat(cloud.colors.mean(axis=1).astype(np.uint8)[:, None], 3, axis=1)
    found = {}
    for name, made in (("shape", _in_gray(cloud)), ("intensity", replace(_in_gray(cloud), colors=gray))):
        scan_map = prepare_map(rooms.stream(made), Workers(2))
        assert scan_map.has_shape
        assert scan_map.has_intensity == (name == "intensity")
        settings = rooms.KNOWN
        photo = rooms.as_panorama(rooms.query(PATTERNED, width=WIDTH).rgb)
        pose = rooms.locate(photo, scan_map, settings).best_pose
        found[name] = rooms.errors(pose, rooms.query(PATTERNED, width=WIDTH).pose)[0]
    assert found["intensity"] < 0.03
    assert found["shape"] > 1.0


@pytest.mark.parametrize("R", [LEVEL, exp_so3(np.array([0.0, 0.1, 0.0])), TILTED])
def test_the_true_rotation_is_one_of_four_by_lines_and_walls(R):
    true = R @ rooms.query(SEED, width=WIDTH).pose.R_cam_from_world @ _shape_map().R_map_from_world.T
    axes = [*true.T, *-true.T]  # the walls of the room are along x and y
    tried = align_lines(_shape_map().yaw_of_walls, axes, R)
    assert tried.shape == (4, 3, 3)
    assert np.degrees(min(angle_between(one, true) for one in tried)) < 1.0
    assert align_lines(_shape_map().yaw_of_walls, axes, exp_so3(np.array([0.5, 0.0, 0.0])) @ R) is None
    assert align_lines(_shape_map().yaw_of_walls, [], R) is None


def test_softer_images_are_whole_across_the_seam():
    rgb = np.zeros((32, 64, 3), np.uint8)
    rgb[:, 0] = 200
    soft = soften(Panorama(rgb, np.ones((32, 64), bool)), 1.7).rgb
    assert (soft[:, 1] == soft[:, -1]).all()
    assert soft[16].sum() == pytest.approx(600, abs=10)


@pytest.mark.parametrize(
    ("clear", "is_known", "searched"),
    [
        ("level", False, ["level"]),
        ("tilt 1", False, ["level", "tilt 0", "tilt 1"]),
        ("any heading", True, ["level", "any heading"]),
        ("any heading", False, ["level", "tilt 0", "tilt 1", "any heading"]),
    ],
)
def test_tilts_and_headings_are_searched_until_a_pose_explains_the_edges(
    monkeypatch, clear, is_known, searched
):
    asked = []

    def at_tilt(name):
        return replace(PROBLEM, rotations=name)

    def find(problem, *_):
        asked.append(problem.rotations or "any heading")
        found = make_selection(make_candidate(0.0, 0.9 if asked[-1] == clear else 0.01))
        return method.Found(problem, found, None)

    for name, made in {
        "find": find,
        "find_axes": lambda _: [],
        "align_level": lambda *_: at_tilt("level"),
        "is_tilt_known": lambda _: is_known,
        "find_tilts": lambda *_: [at_tilt("tilt 0"), at_tilt("tilt 1")],
    }.items():
        monkeypatch.setattr(method, name, made)
    scan_map = SimpleNamespace(yaw_of_walls=0.0)
    found = method.find_by_edges(PROBLEM, scan_map, rooms.means())
    assert (found.problem.rotations or "any heading", asked) == (clear, searched)


def test_a_photo_of_another_room_is_not_localized():
    photo = rooms.as_panorama(rooms.query(2, width=WIDTH).rgb)
    found = rooms.locate(photo, _shape_map())
    assert found.status == "not_localized"


def test_a_photo_of_an_aisle_that_looks_as_the_one_scanned_is_ambiguous():
    """Taken between racks that no station saw. They are as those two metres beside, bay after bay."""
    world = World(RACKS, make_alike("racks", RACKS, 0.0))
    points = scan_world(world, 360_000, Workers(2))[0]
    scan_map = prepare_map(stream_of_arrays(points.astype(float), None), Workers(2))
    taken = make_query(world, 0, "clean", WIDTH, Workers(2))
    found = rooms.locate(rooms.as_panorama(taken.rgb), scan_map, rooms.KNOWN)
    assert found.best_pose.distance(taken.pose) > AISLE - 0.1
    assert found.status == "ambiguous"
    copy = found.alternatives[0]
    assert copy.probability == pytest.approx(found.confidence)
    assert copy.pose.distance(found.best_pose) == pytest.approx(BAY, abs=0.05)


def test_edges_drawn_at_the_true_pose_agree_better_than_elsewhere():
    taken = rooms.query(SEED, width=WIDTH)
    true_pose = _shape_map().from_world(taken.pose)
    beside = replace(true_pose, center_world=true_pose.center_world + np.array([0.3, 0.0, 0.0]))
    problem = rooms.ask(rooms.as_panorama(taken.rgb), _shape_map())
    found = make_selection(*(replace(examine(problem, pose), score=0.2) for pose in (true_pose, beside)))
    standings = assess_alone(problem.profile, complete(problem, found, rooms.WORKERS).candidates)
    assert standings[0].drawn_score > 1.5 * standings[1].drawn_score
    assert log_odds(standings[0]) > log_odds(standings[1])


def test_a_part_of_the_sphere_counts_less():
    taken = rooms.query(SEED, width=WIDTH)
    is_valid = np.zeros(taken.rgb.shape[:2], bool)
    is_valid[:, : WIDTH // 4] = True
    for shown, ratio in ((np.ones_like(is_valid), 1.0), (is_valid, 0.5)):
        problem = rooms.ask(Panorama(taken.rgb, shown), _shape_map())
        candidate = replace(examine(problem, _shape_map().from_world(taken.pose)), score=0.2)
        (standing,) = assess_alone(problem.profile, [candidate])
        assert standing.score == pytest.approx(0.2 * ratio, rel=0.02)


def test_a_map_of_the_shape_is_kept_as_one(tmp_path):
    save_map(_shape_map(), tmp_path / "bare.map")
    back = load_map(tmp_path / "bare.map")
    assert (back.has_shape, back.has_intensity) == (True, False)
    assert SHAPE_ALONE in back.warnings
    np.testing.assert_array_equal(back.octree.nodes, _shape_map().octree.nodes)
    assert not rooms.scan_map(1).has_shape


def _bare_files(folder, points):
    """Files of points without colours, one of each format that needs nothing else."""
    rows = [" ".join(f"{value:.4f}" for value in point) for point in points]
    header = "ply\nformat ascii 1.0\nelement vertex {}\n" + "property double {}\n" * 3 + "end_header\n"
    pcd = "VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {}\nHEIGHT 1\n"
    pcd += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {}\nDATA ascii\n"
    body = "\n".join(rows) + "\n"
    texts = {
        "bare.ply": header.format(len(points), *"xyz") + body,
        "bare.pcd": pcd.format(len(points), len(points)) + body,
        "bare.txt": body,
        "named.txt": "x y z\n" + body,
        "bare.pts": body,
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    np.save(folder / "bare.npy", points)
    np.savez(folder / "bare.npz", points=points)
    (folder / "bare.las").write_bytes(las_bytes(RawCloud(points + OFFSETS, points), point_format=1))
    columns = {f"cartesian{axis}": points[:, k] for k, axis in enumerate("XYZ")}
    e57_files.write(folder / "bare.e57", [e57_files.ScanToWrite(columns)])
    return [*texts, "bare.npy", "bare.npz", "bare.las", "bare.e57"]


def test_files_of_points_alone_are_read_and_others_say_how(tmp_path):
    points = np.round(np.asarray(rooms.room(1)[1].points[:1500], np.float64), 4)
    for name in _bare_files(tmp_path, points):
        cloud = read_cloud(tmp_path / name, CloudSettings(channels=WITHOUT_COLORS))
        shift = OFFSETS if "las" in name else 0.0
        found = np.asarray(cloud.points, np.float64) + cloud.origin_world - shift
        np.testing.assert_allclose(np.sort(found, axis=0), np.sort(points, axis=0), atol=2e-3)
        assert_input_error("wanted", read_cloud, tmp_path / name, IN_COLORS)
        assert not open_cloud([tmp_path / name]).has_colors
    mesh = write_obj(tmp_path, mtl="", uv=None, library="", material="", vertices=3.0 * SQUARE)
    cloud = read_cloud(mesh, CloudSettings(channels=WITHOUT_COLORS))
    assert len(cloud.points) == pytest.approx(90_000, rel=0.01)
    damaged = tmp_path / "broken.ply"
    damaged.write_text("ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(InputError, match="no element 'vertex'") as refused:
        read_cloud(damaged)
    assert "ignore_colors" not in str(refused.value)


def test_files_with_and_without_colours_are_one_scan_by_shape_alone(tmp_path):
    points = np.round(np.asarray(rooms.room(1)[1].points[:1500], np.float64), 4)
    np.save(tmp_path / "bare.npy", points)
    np.save(tmp_path / "colored.npy", np.column_stack([points, np.full_like(points, 100.0)]))
    np.savetxt(tmp_path / "gray.txt", np.column_stack([points, np.arange(1500.0)]))
    both = [tmp_path / "bare.npy", tmp_path / "colored.npy"]
    message = "bare.npy: found no colours, though .*colored.npy has them, wanted them in all"
    assert_input_error(message, open_cloud, both)
    assert open_cloud(both, CloudSettings(channels=WITHOUT_COLORS)).sources[1].channel == "shape"
    mixed = open_cloud([both[0], tmp_path / "gray.txt"])
    assert [source.channel for source in mixed.sources] == ["shape", "shape"]


def test_arrays_and_files_without_colours_are_scans(tmp_path):
    points = rooms.room(1)[1].points
    np.save(tmp_path / "colored.npy", np.column_stack([points, np.full_like(points, 100.0)]))
    ignoring = piccolo.Cloud(tmp_path / "colored.npy", ignore_colors=True)
    for source in (points[::4], ignoring):
        assert SHAPE_ALONE in piccolo.open_scan(source, cache=False).warnings


def test_the_preset_paper_wants_colors():
    bare = piccolo.Cloud(rooms.room(1)[1].points, ignore_colors=True)
    with pytest.raises(InputError, match="found no colours to be used, wanted some for the preset paper"):
        piccolo.open_scan(bare, settings=piccolo.PaperSettings())


def test_the_command_localizes_in_a_scan_without_colours(tmp_path, capsys):
    save_map(_shape_map(), tmp_path / "bare.map")
    taken = rooms.query(SEED, width=WIDTH)
    cv2.imwrite(str(tmp_path / "a photo.png"), taken.rgb[..., ::-1])
    arguments = ["--cloud", str(tmp_path / "bare.map"), "--pano", str(tmp_path / "a photo.png")]
    code = command_line.main([*arguments, "--quiet"])
    out = json.loads(capsys.readouterr().out)
    found = out if out["center_world"] else out["best_guess"]
    assert np.linalg.norm(np.array(found["center_world"]) - taken.pose.center_world) < 0.1
    assert SHAPE_ALONE in out["warnings"]
    assert code == (0 if out["status"] == "localized" else 1)
