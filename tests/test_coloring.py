"""Colours of scans from photos: what photos see, their alignment and exposures, medians, and files."""

import functools
import json
from dataclasses import replace

import cv2
import laspy
import numpy as np
import pytest
import rooms
from batches import untimed
from refusals import assert_input_error
from scans import read_cloud
from scipy.spatial import cKDTree

import piccolo
from piccolo.apps import color_scan as tool
from piccolo.batch.jobs import steps_file
from piccolo.cli import localize as command_line
from piccolo.cloud.octree import build_octree, recolor
from piccolo.cloud.stream import open_cloud
from piccolo.cloud.writers import vertex_rows, write_colored, writing_e57
from piccolo.geometry.pose import Pose, pose_errors, step
from piccolo.judge.pose_covariance import PoseCovariance
from piccolo.judge.result import Result
from piccolo.photo.panorama import Panorama
from piccolo.scan_map.scan_map import prepare_map
from piccolo.system.errors import InputError, ResourceError
from piccolo.system.files.line_file import Journal
from piccolo.system.jobs.memory import memory_taken
from piccolo.system.jobs.threads import Workers
from piccolo.together.coloring import alignment, painting
from piccolo.together.coloring.alignment import Anchor, add_pairs, align, balance, look, weigh_points
from piccolo.together.coloring.painting import (
    PAINTED,
    find_medians,
    localize_by_colors,
    make_aligned_brushes,
    make_brushes,
    paint_points,
)

TIER = "scene"

SEED = 1
NUM_POINTS = 60_000
NUM_IN_FILE = 20_000  # points, where the command is tested
WIDTH = 512

pytestmark = pytest.mark.usefixtures("coarse_colors")


@functools.lru_cache
def _octree():
    return build_octree(rooms.stream(rooms.room(SEED, NUM_POINTS)[1]).voxels(np.eye(3)))


@functools.lru_cache
def _photos(count=3):
    """Photos of a made room, and their poses in the map."""
    taken = [rooms.query(SEED, index=k, width=WIDTH) for k in range(count)]
    photos = [Panorama(one.rgb, np.ones(one.rgb.shape[:2], bool)) for one in taken]
    return photos, [rooms.local(SEED, one.pose, NUM_POINTS) for one in taken]


def test_medians_are_those_of_numpy_by_weight():
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 256, (5, 40, 3)).astype(np.float32)
    weights = rng.integers(0, 3, (5, 40)).astype(np.float32)
    weights[:, 0] = 0.0
    found = np.empty((40, 3), np.uint8)
    counts = np.empty(40, np.uint8)
    find_medians(colors, weights, found, counts)
    assert (counts == (weights > 0).sum(axis=0)).all()
    assert (found[0] == 0).all()
    for n in range(1, 40):
        for c in range(3):
            every = np.sort(np.repeat(colors[:, n, c], weights[:, n].astype(int)))
            assert found[n, c] == (every[(len(every) - 1) // 2] if len(every) else 0)


def test_gains_undo_exposures():
    rng = np.random.default_rng(1)
    gains = np.array([0.8, 1.0, 1.25])
    colors = rng.uniform(40, 180, (500, 3))
    point, photo = (values.ravel() for values in np.meshgrid(np.arange(500), np.arange(3), indexing="ij"))
    values = (colors[point] / gains[photo][:, None]).astype(np.float32)
    values[::7] = np.nan
    assert np.allclose(balance(point, photo, values, 3), gains[:, None], atol=0.01)


def test_pairs_have_the_gradient_of_their_loss():
    rng = np.random.default_rng(2)
    first = np.array([0, 2, 5])
    photo = np.array([0, 1, 0, 1, 2])
    rows = rng.normal(size=(5, 3, 6)).astype(np.float32)
    values = rng.uniform(0, 20, (5, 3)).astype(np.float32)

    def sums(x):
        moved = values + np.einsum("scp,sp->sc", rows, x.reshape(3, 6)[photo]).astype(np.float32)
        matrix, gradient = np.zeros((18, 18)), np.zeros(18)
        return add_pairs(first, photo, moved, rows, 20.0, matrix, gradient), matrix, gradient

    _, matrix, gradient = sums(np.zeros(18))
    for k in range(18):
        x = 0.05 * np.eye(18)[k]
        assert (sums(x)[0] - sums(-x)[0]) / 0.1 == pytest.approx(gradient[k], rel=0.02, abs=0.02)
    assert np.allclose(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > -1e-6


def test_leaves_without_a_colour_get_one_from_around():
    octree = _octree()
    begin = octree.level_start[-2]
    colors = octree.nodes[begin:, 3:]
    weights = np.ones(len(colors), np.float32)
    assert np.array_equal(recolor(octree, colors, weights).nodes, octree.nodes)
    weights[::5] = 0.0
    wrong = np.where(weights[:, None] > 0.0, colors, np.float32(1.0))
    filled = recolor(octree, wrong, weights).nodes[begin:, 3:]
    assert np.median(np.abs(filled - colors)[::5]) < 0.02
    assert np.array_equal(filled[1:5], colors[1:5])


def test_a_photo_sees_what_is_in_front_and_nothing_behind_walls():
    _, poses = _photos()
    sight = look(_octree(), poses[0])
    leaves = _octree().level(0.02)[:, :3]
    away = leaves - poses[0].center_world.astype(np.float32)
    points = np.concatenate([leaves, leaves + 0.5 * away / np.linalg.norm(away, axis=1, keepdims=True)])
    found = np.empty(len(points), np.float32)
    R, t = poses[0].R_cam_from_world, poses[0].center_world
    weigh_points(np.ascontiguousarray(points, np.float32), sight, R, t, found)
    assert (found[: len(leaves)] > 0.0).mean() > 0.5
    assert (found[len(leaves) :] > 0.0).mean() < 0.1


def test_photos_that_were_moved_are_aligned_and_paint_the_room():
    photos, poses = _photos()
    octree = _octree()
    rng = np.random.default_rng(3)
    moved = [step(pose, np.repeat([0.004, 0.02], 3) * rng.normal(size=6)) for pose in poses]
    information = np.diag([1 / 0.01**2] * 3 + [1 / 0.04**2] * 3)
    anchors = [Anchor(pose, information) for pose in moved]
    aligned, _ = align(octree, photos, moved, anchors, Workers(2))
    before = [pose_errors(a, b)[0] for a, b in zip(moved, poses, strict=True)]
    after = [pose_errors(a, b)[0] for a, b in zip(aligned, poses, strict=True)]
    assert np.mean(after) < 0.5 * np.mean(before)
    again, _ = align(octree, photos, moved, anchors, Workers(1))
    pairs = zip(aligned, again, strict=True)
    assert all(np.array_equal(a.center_world, b.center_world) for a, b in pairs)
    brushes = make_brushes(octree, photos, poses, np.ones((3, 3), np.float32), Workers(2))
    leaves = octree.level(octree.leaf_size)
    paint = paint_points(np.ascontiguousarray(leaves[:, :3]), brushes, Workers(2))
    is_seen = paint.num_photos > 1
    assert is_seen.mean() > 0.3
    assert np.median(np.abs(paint.colors / 255.0 - leaves[:, 3:]).max(axis=1)[is_seen]) < 12 / 255


def _gray_map(cloud):
    """A map of a scan's shape alone."""
    gray = replace(cloud, colors=np.full_like(cloud.colors, 128), has_colors=False)
    return prepare_map(rooms.stream(gray), Workers(2))


@functools.lru_cache
def _two_alike():
    """A map of a room and its copy 20 m away."""
    cloud = rooms.room(SEED, 20_000)[1]
    apart = cloud.points + np.float32([20.0, 0.0, 0.0])
    points = np.concatenate([cloud.points, apart])
    return _gray_map(replace(cloud, points=points, colors=np.tile(cloud.colors, (2, 1))))


def _result(path, rgb, pose):
    """A photo that was localized at a pose in the world, to 3 cm and 0.3 degrees."""
    cv2.imwrite(str(path), rgb[..., ::-1])
    covariance = PoseCovariance(np.diag([0.005**2] * 3 + [0.03**2] * 3), "")
    return Result("localized", 0.95, "scan", str(path), best_pose=pose, covariance=covariance)


def test_a_photo_sees_the_paint_of_others_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(painting, "MOST_FOLDS", 2)
    poses = [rooms.query(SEED, index=k).pose for k in range(3)]
    poses.append(Pose(poses[0].R_cam_from_world, poses[0].center_world + np.array([20.0, 0.0, 0.0])))
    colors = np.uint8([[255, 0, 0], [0, 255, 0], [0, 0, 255], [20, 20, 20]])
    pictures = [np.full((64, 128, 3), color) for color in colors]
    photos = zip(pictures, poses, strict=True)
    by_shape = [_result(tmp_path / f"{k}.png", *photo) for k, photo in enumerate(photos)]
    shown = []

    def localize(painted, k):
        leaves = painted.octree.level(painted.octree.leaf_size)
        shown.append((k, {c for c in range(3) if leaves[:, 3 + c].max() > 0.5}))
        return replace(by_shape[k], status="not_localized" if k == 2 else "localized", confidence=0.5)

    results = localize_by_colors(_two_alike(), by_shape, localize, Workers(2), Journal())
    first, second = dict(shown[:3]), dict(shown[3:])
    assert first == {0: {1}, 1: {0, 2}, 2: {1}}  # the first and the third are one fold
    assert second == {0: {1}, 1: {0}, 2: {0, 1}}  # the one that was refused does not paint
    assert [result.confidence for result in results] == [0.5, 0.5, 0.5, 0.95]  # the last one is alone


def test_a_stranger_is_not_localized_by_its_own_paint(tmp_path, monkeypatch):
    monkeypatch.setattr(painting, "NUM_COLORING_ROUNDS", 1)
    scan_map = _gray_map(rooms.room(SEED, 40_000)[1])
    settings = rooms.KNOWN
    right = [rooms.query(SEED, index=k, width=WIDTH) for k in range(2)]
    there = step(right[0].pose, np.array([0.0, 0.0, 0.7, 0.9, 0.5, 0.0]))
    photos = [(one.rgb, one.pose) for one in right] + [(rooms.query(2, width=WIDTH).rgb, there)]
    by_shape = [_result(tmp_path / f"{k}.png", *photo) for k, photo in enumerate(photos)]

    def localize_one(painted, k):
        panorama = rooms.as_panorama(photos[k][0])
        found = rooms.locate(panorama, painted, settings)
        about = {name: getattr(found, name) for name in ("status", "confidence", "covariance")}
        return replace(by_shape[k], best_pose=found.best_pose, **about)

    results = localize_by_colors(scan_map, by_shape, localize_one, Workers(2), Journal())
    assert [result.status for result in results] == ["localized"] * 2 + ["not_localized"]
    errors = [pose_errors(r.pose, one.pose)[0] for r, one in zip(results, right, strict=False)]
    assert max(errors) < 0.02


def test_the_photos_that_see_a_point_best_are_kept():
    rng = np.random.default_rng(5)
    weights = np.maximum(rng.normal(size=(20, 50)), 0.0).astype(np.float32)
    sightings = alignment.keep_best(weights, 50, 20)
    for n in range(50):
        wanted = sorted(k for k in np.argsort(-weights[:, n])[:6] if weights[k, n] > 0.0)
        own = slice(*sightings.first[n : n + 2])
        assert (sightings.point[own] == n).all()
        assert sightings.photo[own].tolist() == wanted
    assert all((sightings.photo[own] == k).all() for k, own in enumerate(sightings.own))


def test_colours_that_need_too_much_memory_are_refused(tmp_path, limiting):
    scan_map = _gray_map(rooms.room(SEED)[1])
    one = rooms.query(SEED)
    results = [_result(tmp_path / "0.png", one.rgb, one.pose)] * 2
    limiting(memory_taken() / 1e9 + 0.004)
    with pytest.raises(ResourceError, match=r"^colouring by 2 photos needs .* localize fewer at once"):
        make_aligned_brushes(scan_map, results, Workers(1))
    points = np.zeros((100_000, 3))
    colors = points.astype(np.uint8)
    with (
        pytest.raises(ResourceError, match=r"out.e57: 100000 points at once needs .* write LAZ or PLY"),
        writing_e57(tmp_path / "out.e57", np.zeros((2, 3)), 1.0, "") as add,
    ):
        add(points, colors, colors[:, 0])


@pytest.mark.parametrize("suffix", [".ply", ".las", ".laz", ".e57"])
def test_colours_are_written_in_each_format(tmp_path, suffix):
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 9, (3000, 3)) + np.array([500_000.0, 5_800_000.0, 100.0])
    source = tmp_path / "cloud.ply"
    rooms.write_ply(source, vertex_rows(points, np.full((3000, 3), 9, np.uint8)))
    wanted = rng.integers(0, 256, (3000, 3)).astype(np.uint8)
    out = tmp_path / f"a b{suffix}"
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    counts = write_colored(open_cloud([source]), lambda _: (wanted, np.ones(3000, np.uint8)), box, out)
    assert counts == (3000, 3000)
    found = read_cloud(out)
    distances, nearest = cKDTree(found.points + found.origin_world).query(points)
    assert distances.max() < 2e-3
    assert (found.colors[nearest] == wanted).all()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_file_that_is_not_finished_is_closed(tmp_path, monkeypatch, suffix):
    """The source fails between two chunks: nothing is left, and the library's writer has ended."""
    source = tmp_path / "cloud.ply"
    points = np.random.default_rng(4).uniform(0, 9, (3000, 3))
    rooms.write_ply(source, vertex_rows(points, np.full((3000, 3), 9, np.uint8)))
    closed = []
    close = laspy.LasWriter.close
    monkeypatch.setattr(laspy.LasWriter, "close", lambda self: closed.append(close(self)))

    def fail(_):
        raise InputError("the file was cut")

    with pytest.raises(InputError, match="cut"):
        write_colored(open_cloud([source]), fail, np.array([[0.0] * 3, [9.0] * 3]), tmp_path / f"a{suffix}")
    assert len(closed) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Options of a scan in a file and its cache, and two photos of it."""
    folder = tmp_path_factory.mktemp("coloring")
    cloud = rooms.write_cloud(folder / "scan.ply", SEED, NUM_IN_FILE)
    photos = [str(folder / f"photo {k}.png") for k in range(2)]
    for k, path in enumerate(photos):
        cv2.imwrite(path, rooms.query(SEED, index=k, width=WIDTH // 2).rgb[..., ::-1])
    return ["--cloud", cloud, "--cache", str(folder / "cache")], photos


def _words(files, out):
    cloud, photos = files
    words = ["--pano", *photos, "--gravity", "known", "--color-scan", f"{out}.ply", "--out", f"{out}.jsonl"]
    return [*cloud, *words]


@pytest.fixture(scope="module")
def whole(files, tmp_path_factory):
    """The path, without its suffix, of a scan that was coloured without a stop, and of its results."""
    out = tmp_path_factory.mktemp("whole") / "colored"
    assert command_line.main([*_words(files, out), "--quiet"]) == 0
    return out


def test_the_commands_colour_a_scan(files, whole, tmp_path, capsys):
    cloud, _ = files
    lines = tmp_path / "poses.jsonl"
    again = tmp_path / "again.ply"
    found = [json.loads(line) for line in whole.with_suffix(".jsonl").read_text().splitlines()]
    assert [result["status"] for result in found] == ["localized"] * 2
    assert all(PAINTED in result["warnings"] for result in found)
    lines.write_bytes(whole.with_suffix(".jsonl").read_bytes())
    assert tool.main([*cloud, "--results", str(lines), "--out", str(again)]) == 0
    assert json.loads(capsys.readouterr().out)["photos"] == 2
    assert len(read_cloud(again).points) == NUM_IN_FILE
    assert command_line.main(_words(files, whole)) == 0
    assert "nothing is left to do" in capsys.readouterr().err
    lines.write_text(lines.read_text().splitlines()[0] + "\n")
    assert tool.main([*cloud, "--results", str(lines), "--out", str(again)]) == 3
    assert "found 1 localized photos, wanted 2" in capsys.readouterr().err


def test_a_colouring_that_is_stopped_twice_goes_on_with_the_same_bits(
    files, whole, tmp_path, monkeypatch, capsys
):
    """Two photos are localized by shape, then twice by colours; it is killed after steps one and five."""
    out = tmp_path / "stopped"
    steps = []
    append = Journal.append

    def count(self, step, text):
        if len(steps) == num_kept:
            raise MemoryError
        steps.append(step)
        append(self, step, text)

    monkeypatch.setattr(Journal, "append", count)
    for num_kept in (1, 5):
        assert command_line.main(_words(files, out)) == 3
        assert steps_file(out.with_suffix(".jsonl")).exists()
        assert len(steps) == num_kept
    num_kept = None
    assert command_line.main(_words(files, out)) == 0
    assert len(steps) == 6
    assert "of the points coloured" in capsys.readouterr().err
    assert untimed(out.with_suffix(".jsonl")) == untimed(whole.with_suffix(".jsonl"))
    assert out.with_suffix(".ply").read_bytes() == whole.with_suffix(".ply").read_bytes()
    assert not steps_file(out.with_suffix(".jsonl")).exists()


def test_colouring_from_python_says_what_is_missing(files, tmp_path):
    cloud, photos = files
    scan = piccolo.open_scan(cloud[1], cache=cloud[3])
    out = tmp_path / "colored.ply"
    found = scan.color(photos[:1], out, gravity="known")
    assert ([r.status for r in found.results], found.num_points) == (["localized"], 0)
    assert not out.exists()
    assert_input_error("`photos`: found an array", scan.color, [np.zeros((8, 16, 3), np.uint8)], out)
    assert_input_error("wanted a name that ends with", scan.color, photos, tmp_path / "a.xyz")
    assert_input_error("^room: found no files of points", rooms.scan(SEED).color, photos, out)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [(["--jobs", "2"], "--jobs: not with --color-scan"), (["--color-scan", "a.xyz"], "a.xyz: wanted a name")],
)
def test_what_does_not_go_with_colouring_is_refused(files, capsys, wrong, text):
    cloud, photos = files
    assert command_line.main([*cloud, "--pano", *photos, "--color-scan", "a.ply", *wrong]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(("is_broken", "code"), [(False, 1), (True, 3)])
def test_with_nothing_to_colour_by_the_command_says_so(files, tmp_path, capsys, is_broken, code):
    cloud, photos = files
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"no picture")
    panos = [photos[0], str(broken)][: 1 + is_broken]
    out, lines = tmp_path / "none.ply", tmp_path / "one.jsonl"
    given = [*cloud, "--pano", *panos, "--gravity", "known", "--color-scan", str(out), "--out", str(lines)]
    assert command_line.main([*given, "--quiet"]) == code
    assert "none.ply is not written: wanted 2 localized photos or more" in capsys.readouterr().err
    assert not out.exists()
    found = [json.loads(line)["status"] for line in lines.read_text().splitlines()]
    assert found == ["localized", "unreadable"][: 1 + is_broken]
