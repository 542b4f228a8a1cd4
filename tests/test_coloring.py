"""Colours of scans from photos: what photos see, their alignment and exposures, medians, and files."""

import functools
import json

import cv2
import laspy
import numpy as np
import pytest
import rooms
from scipy.spatial import cKDTree

from piccolo.cli import color_scan as tool
from piccolo.cli import localize as command_line
from piccolo.cloud import open_cloud, read_cloud
from piccolo.cloud.colored_writer import write_colored
from piccolo.cloud.octree import build_octree, recolor
from piccolo.cloud.ply_writer import vertex_rows, write_ply
from piccolo.coloring.alignment import Anchor, add_pairs, align
from piccolo.coloring.exposure import balance
from piccolo.coloring.painting import find_medians, make_brushes, paint_points
from piccolo.coloring.sight import look, weigh_points
from piccolo.errors import InputError
from piccolo.geometry.pose import pose_errors, step
from piccolo.jobs.threads import Workers
from piccolo.panorama import Panorama

SEED = 1
NUM_POINTS = 200_000
WIDTH = 1024


@functools.lru_cache
def _octree():
    return build_octree(rooms.room(SEED, NUM_POINTS)[1].voxels(np.eye(3)))


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
    weigh_points(np.ascontiguousarray(points, np.float32), *sight, R, t, found)
    assert (found[: len(leaves)] > 0.0).mean() > 0.5
    assert (found[len(leaves) :] > 0.0).mean() < 0.1


def test_photos_that_were_moved_are_aligned_and_paint_the_room():
    photos, poses = _photos()
    octree = _octree()
    rng = np.random.default_rng(3)
    moved = [step(pose, np.repeat([0.004, 0.02], 3) * rng.normal(size=6)) for pose in poses]
    information = np.diag([1 / 0.01**2] * 3 + [1 / 0.04**2] * 3)
    anchors = [Anchor(pose, information) for pose in moved]
    aligned = align(octree, photos, moved, anchors, Workers(2))
    before = [pose_errors(a, b)[0] for a, b in zip(moved, poses, strict=True)]
    after = [pose_errors(a, b)[0] for a, b in zip(aligned.poses, poses, strict=True)]
    assert np.mean(after) < 0.5 * np.mean(before)
    again = align(octree, photos, moved, anchors, Workers(1))
    pairs = zip(aligned.poses, again.poses, strict=True)
    assert all(np.array_equal(a.center_world, b.center_world) for a, b in pairs)
    brushes = make_brushes(octree, photos, poses, np.ones((3, 3), np.float32), Workers(2))
    leaves = octree.level(octree.leaf_size)
    paint = paint_points(np.ascontiguousarray(leaves[:, :3]), brushes, Workers(2))
    is_seen = paint.num_photos > 1
    assert is_seen.mean() > 0.3
    assert np.median(np.abs(paint.colors / 255.0 - leaves[:, 3:]).max(axis=1)[is_seen]) < 12 / 255


@pytest.mark.parametrize("suffix", [".ply", ".las", ".laz", ".e57"])
def test_colours_are_written_in_each_format(tmp_path, suffix):
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 9, (3000, 3)) + np.array([500_000.0, 5_800_000.0, 100.0])
    source = tmp_path / "cloud.ply"
    write_ply(source, vertex_rows(points, np.full((3000, 3), 9, np.uint8)))
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
    write_ply(source, vertex_rows(points, np.full((3000, 3), 9, np.uint8)))
    closed, close = [], laspy.LasWriter.close
    monkeypatch.setattr(laspy.LasWriter, "close", lambda self: closed.append(close(self)))

    def fail(_):
        raise InputError("the file was cut")

    with pytest.raises(InputError, match="cut"):
        write_colored(open_cloud([source]), fail, np.array([[0.0] * 3, [9.0] * 3]), tmp_path / f"a{suffix}")
    assert len(closed) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]


def test_the_commands_colour_a_scan(tmp_path, capsys):
    scan = rooms.room(SEED, NUM_POINTS)[1]
    write_ply(tmp_path / "scan.ply", vertex_rows(scan.points + scan.origin_world, scan.colors))
    photos = []
    for k in range(2):
        path = tmp_path / f"photo {k}.png"
        cv2.imwrite(str(path), rooms.query(SEED, index=k, width=WIDTH).rgb[..., ::-1])
        photos.append(str(path))
    cloud = ["--cloud", str(tmp_path / "scan.ply"), "--cache", str(tmp_path / "cache")]
    out, lines = tmp_path / "colored.ply", tmp_path / "poses.jsonl"
    given = [*cloud, "--pano", *photos, "--gravity", "known", "--color-scan", str(out), "--out", str(lines)]
    assert command_line.main(given) == 0
    assert "of the points coloured" in capsys.readouterr().err
    assert [json.loads(line)["status"] for line in lines.read_text().splitlines()] == ["localized"] * 2
    again = tmp_path / "again.ply"
    assert tool.main([*cloud, "--results", str(lines), "--out", str(again)]) == 0
    assert json.loads(capsys.readouterr().out)["photos"] == 2
    assert len(read_cloud(again).points) == len(scan.points)
    assert command_line.main(given) == 2
    assert "has results already" in capsys.readouterr().err
    for wrong in (["--jobs", "2"], ["--color-scan", str(tmp_path / "a.xyz")]):
        assert command_line.main([*given, "--overwrite", *wrong]) in (2, 3)
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"no picture")
    one = [
        *cloud,
        "--pano",
        photos[0],
        str(broken),
        "--gravity",
        "known",
        "--out",
        str(tmp_path / "one.jsonl"),
    ]
    assert command_line.main([*one, "--color-scan", str(tmp_path / "none.ply")]) == 3
    err = capsys.readouterr().err
    assert "broken.jpg: " in err
    assert "none.ply is not written: wanted 2 localized photos or more" in err
    assert not (tmp_path / "none.ply").exists()
    found = [json.loads(line)["status"] for line in (tmp_path / "one.jsonl").read_text().splitlines()]
    assert found == ["localized", "unreadable"]
    lines.write_text(lines.read_text().splitlines()[0] + "\n")
    assert tool.main([*cloud, "--results", str(lines), "--out", str(again)]) == 3
    assert "found 1 localized photos, wanted 2" in capsys.readouterr().err
