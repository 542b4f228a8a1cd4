"""Semantic labels as colours: the palette, labels of points and pictures, and the command line."""

import re

import cv2
import numpy as np
import pytest
import rooms
from clouds import seeded_cloud, whole
from las_files import OFFSETS, las_bytes, laz_bytes
from pcd_files import content_of
from pictures import write
from plyfile import PlyData, PlyElement
from refusals import assert_input_error, assert_refused
from rooms import errors, write_room
from scans import write_scalars
from scipy.spatial.distance import pdist

from piccolo.cli import localize, prepare_map
from piccolo.cloud.readers.reader import RawCloud
from piccolo.cloud.settings import WITHOUT_COLORS, CloudSettings
from piccolo.cloud.stream import open_cloud, open_source
from piccolo.geometry.colors import NUM_COLORS, Labels, label_colors, palette
from piccolo.judge.result import Result
from piccolo.photo.panorama import read_panorama
from piccolo.photo.photo import Photo
from piccolo.system.errors import InputError
from research.evaluation import evaluate
from research.evaluation.query_result import read_run
from research.scene import read_scene
from research.synthetic.layout import LABEL_NAMES

TIER = "scene"

POINTS = seeded_cloud(1, num_points=3000).points_world
LABELS = np.random.default_rng(2).integers(0, 21, 3000)
READ = CloudSettings(labels=Labels())
IMAGE = np.random.default_rng(3).integers(0, 200, (64, 128))
READ_IMAGE = Labels()


@pytest.mark.parametrize(("count", "least"), [(16, 123.0), (64, 68.0), (256, 38.0), (NUM_COLORS, 16.0)])
def test_colors_of_the_first_labels_are_far_apart(count, least):
    assert pdist(label_colors(np.arange(count)).astype(float)).min() >= least


def test_no_color_is_black_and_a_label_alone_decides():
    assert palette().max(axis=1).min() > 0
    shuffled = np.array([[5, 70_000], [-1, 5]])
    np.testing.assert_array_equal(label_colors(shuffled)[0, 0], label_colors(shuffled)[1, 1])
    np.testing.assert_array_equal(label_colors(shuffled)[1, 0], palette()[NUM_COLORS - 1])
    for step in (256, 65_536):
        assert len(np.unique(label_colors(step * np.arange(256)), axis=0)) == 256


def _ply(path, name="label", kind="i4", text=False, values=LABELS, points=POINTS):
    return write_scalars(path, points, name, values, kind, text)


@pytest.mark.parametrize(
    "name", ["label", "class", "Classification", "scalar_Label", "scalar_Classification"]
)
@pytest.mark.parametrize(("kind", "text"), [("u1", False), ("i4", True), ("f4", False), ("f8", True)])
def test_ply(tmp_path, name, kind, text):
    read = whole(open_source, _ply(tmp_path / "a.ply", name, kind, text), READ)
    np.testing.assert_array_equal(read.colors, label_colors(LABELS))
    np.testing.assert_allclose(read.points_world, POINTS, rtol=1e-14)


def test_ignored_labels_are_left_out(tmp_path):
    read = whole(open_source, _ply(tmp_path / "a.ply"), CloudSettings(labels=Labels((0, 7, 99))))
    is_kept = (LABELS != 0) & (LABELS != 7)
    np.testing.assert_array_equal(read.points_world, POINTS[is_kept])
    np.testing.assert_array_equal(read.colors, label_colors(LABELS[is_kept]))
    everything = CloudSettings(labels=Labels(tuple(range(21))))
    with pytest.raises(InputError, match="found 0 finite points"):
        open_cloud([tmp_path / "a.ply"], everything).read()


@pytest.mark.parametrize("wrong", [3.5, np.nan, -np.inf, 1e12])
def test_labels_that_are_no_whole_numbers_are_refused(tmp_path, wrong):
    path = _ply(tmp_path / "a.ply", kind="f8", values=np.where(np.arange(3000) == 1700, wrong, LABELS))
    message = f"a.ply: found the label {wrong:g}, wanted whole numbers"
    assert_input_error(re.escape(message), whole, open_source, path, READ)


def test_points_without_a_position_need_no_label(tmp_path):
    broken = POINTS.copy()
    broken[5] = np.nan
    values = np.where(np.arange(3000) == 5, np.nan, LABELS)
    path = _ply(tmp_path / "a.ply", kind="f4", values=values, points=broken)
    cloud = open_cloud([path], CloudSettings(labels=Labels())).read()
    assert len(cloud.points) == 2999
    assert "1 points with NaN" in cloud.warnings[0]


@pytest.mark.parametrize(("point_format", "most"), [(0, 31), (3, 31), (6, 255), (7, 255)])
@pytest.mark.parametrize("is_compressed", [False, True])
def test_las(tmp_path, point_format, most, is_compressed):
    raw = RawCloud(np.round(POINTS, 2) + OFFSETS, np.zeros((3000, 3), np.uint8))
    classes = np.arange(3000) % (most + 1)
    withheld = np.arange(3000) >= 2900
    content = las_bytes(raw, point_format, classes=classes, withheld=withheld)
    path = write(tmp_path / "a.las", laz_bytes(content, chunk=700) if is_compressed else content)
    read = whole(open_source, path, READ)
    np.testing.assert_array_equal(read.colors, label_colors(classes[:2900]))


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_pcd(tmp_path, encoding):
    fields = [*((axis, "f4", 1, POINTS[:, k]) for k, axis in enumerate("xyz")), ("label", "u4", 1, LABELS)]
    path = write(tmp_path / "a.pcd", content_of(fields, encoding, 3000))
    np.testing.assert_array_equal(whole(open_source, path, READ).colors, label_colors(LABELS))
    write(path, path.read_bytes().replace(b"label", b"ring_"))
    assert_refused("the fields are 'x y z ring_', wanted x y z and label", open_source, path, READ)


def test_clouds_without_labels_are_refused(tmp_path):
    with pytest.raises(InputError, match="the vertices have x y z thing, wanted x y z and a label"):
        open_source(_ply(tmp_path / "a.ply", "thing"), READ)
    with pytest.raises(InputError, match=r"a.pts: labels are not read from PTS, wanted PLY, LAS, LAZ, PCD"):
        open_source(write(tmp_path / "a.pts", b"3\n1 2 3 9 1 1 1\n"), READ)
    mesh = PlyData.read(str(tmp_path / "a.ply"))
    faces = np.array([([0, 1, 2],)] * 200, dtype=[("vertex_indices", "i4", (3,))])
    PlyData([mesh["vertex"], PlyElement.describe(faces, "face")]).write(str(tmp_path / "mesh.ply"))
    with pytest.raises(InputError, match=r"mesh.ply: found a mesh, wanted points with labels"):
        open_source(tmp_path / "mesh.ply", READ)
    with pytest.raises(InputError, match="`ignore_colors`, `labels`: found both"):
        CloudSettings(channels=WITHOUT_COLORS, labels=Labels())


def _png(path, pixels):
    assert cv2.imwrite(str(path), pixels)
    return path


def test_pictures_of_labels_in_8_16_and_24_bits(tmp_path):
    deep = IMAGE * 300
    of_24_bits = deep * 256 + 9
    bgr = np.stack([of_24_bits & 255, of_24_bits >> 8 & 255, of_24_bits >> 16], axis=-1)
    for labels, pixels in ((IMAGE, np.uint8(IMAGE)), (deep, np.uint16(deep)), (of_24_bits, np.uint8(bgr))):
        panorama = read_panorama(_png(tmp_path / "a.png", pixels), READ_IMAGE)
        np.testing.assert_array_equal(panorama.rgb, label_colors(labels))
        assert panorama.is_valid.all()


def test_ignored_labels_and_masks_do_not_count_and_nothing_else_is_masked(tmp_path):
    labels = IMAGE.copy()
    labels[:9], labels[-9:] = 0, 1  # as a black border and a disc over the nadir look in colours
    path = _png(tmp_path / "a.png", labels.astype(np.uint8))
    assert read_panorama(path, READ_IMAGE).is_valid.all()
    is_left = np.broadcast_to(np.arange(128) < 20, (64, 128))
    mask = _png(tmp_path / "mask.png", np.uint8(255 * is_left))
    panorama = read_panorama(Photo(path, mask=mask, mask_nadir_deg=20.0), Labels((0, 5)))
    expected = (labels != 0) & (labels != 5) & (np.arange(128) >= 20)
    expected[-7:] = False
    np.testing.assert_array_equal(panorama.is_valid, expected)
    with pytest.raises(InputError, match="no pixel is left: all are masked, black, or of ignored"):
        read_panorama(path, Labels(tuple(range(256))))


def test_pictures_that_do_not_keep_labels_are_refused(tmp_path):
    gray = IMAGE.astype(np.uint8)
    rgba = np.zeros((64, 128, 4), np.uint8)
    wanted = "this kind of picture holds no labels, wanted a PNG, grey of 8 or 16 bits or RGB of 8"
    deep_rgb = np.zeros((64, 128, 3), np.uint16)
    for path in (
        _png(tmp_path / "a.jpg", gray),
        _png(tmp_path / "a.webp", gray),
        _png(tmp_path / "rgba.png", rgba),
        _png(tmp_path / "deep.png", deep_rgb),
    ):
        assert_refused(f"{path.name}: {wanted}", read_panorama, path, READ_IMAGE)
    _, bits = cv2.imencode(".png", gray, [cv2.IMWRITE_PNG_BILEVEL, 1])
    assert_refused(wanted, read_panorama, write(tmp_path / "b.png", bytes(bits)), READ_IMAGE)
    with pytest.raises(InputError, match=r"found labels of 128 x 65, wanted the full sphere, W = 2 H"):
        read_panorama(_png(tmp_path / "c.png", np.zeros((65, 128), np.uint8)), READ_IMAGE)
    with pytest.raises(InputError, match="`labels`: found `fov_deg` or `projection` too"):
        read_panorama(Photo(path, fov_deg=90.0), Labels())


PAPER = ["--preset", "paper", "num_translations=30", "num_iterations=60", "max_points=30000"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A room with labels, and one panorama."""
    words = "--seed 7 --width 512 --points 60000 --panoramas 1 --labels"
    return write_room(tmp_path_factory.mktemp("labels"), words)


def _localized(scene, capsys, *options, pano="labels/clean_0.png"):
    files = ["--cloud", str(scene / "cloud.ply"), "--cache", str(scene.parent / "maps"), "--quiet"]
    code = localize.main([*files, "--pano", str(scene / pano), *options])
    out, err = capsys.readouterr()
    return (Result.from_json(out) if out else None), code, err


def test_room_maker_labels_points_and_pixels_alike(scene):
    (query,) = read_scene(scene).queries
    picture = cv2.imread(str(query.labels), cv2.IMREAD_UNCHANGED)
    vertices = PlyData.read(str(scene / "cloud.ply"))["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    x, y, z = query.pose.R_cam_from_world @ (points - query.pose.center_world).T
    column = (512 * (0.5 - np.arctan2(y, x) / (2 * np.pi))).astype(int) % 512
    row = (512 * (0.25 - np.arctan2(z, np.hypot(x, y)) / (2 * np.pi))).astype(int)
    assert (picture[row, column] == vertices["label"]).mean() > 0.7  # the rest is hidden
    assert picture.dtype == np.uint16
    assert set(np.unique(picture)) <= set(range(1, len(LABEL_NAMES)))
    for kind, side in (("floor", points[:, 2] < 0.02), ("ceiling", points[:, 2] > 2.48)):
        assert (vertices["label"][side] == LABEL_NAMES.index(kind)).mean() > 0.3
    assert (picture[[0, -1]] == [[LABEL_NAMES.index("ceiling")], [picture[-1, 0]]]).all()


@pytest.mark.parametrize("preset", [[], PAPER])
def test_camera_is_found_by_labels(scene, capsys, preset):
    result, code, _ = _localized(scene, capsys, "--labels", *preset)
    rooms.assert_near(result.pose, read_scene(scene).queries[0].pose, 0.05, 1.0)
    assert code == (0 if result.status == "localized" else 1)
    assert result.settings["cloud"]["labels"] == result.settings["panorama"]["labels"] == {"ignored": []}


def test_ignored_labels_stand_in_the_result_and_everything_ignored_is_refused(scene, capsys):
    ceiling = str(LABEL_NAMES.index("ceiling"))
    result, _, _ = _localized(scene, capsys, "--labels", "99", ceiling)
    assert errors(result.pose, read_scene(scene).queries[0].pose)[0] < 0.05
    assert result.settings["cloud"]["labels"] == {"ignored": [int(ceiling), 99]}
    everything = map(str, range(len(LABEL_NAMES)))
    _, code, err = _localized(scene, capsys, "--labels", *everything)
    assert code == 3
    assert "cloud.ply: found 0 finite points" in err


def test_wrong_use_of_labels_is_refused(scene, capsys):
    for code, options, message in (
        (2, "--labels --ignore-colors", "--ignore-colors, --labels: found both"),
        (2, "--labels --fov 90", "--labels: found --fov or --projection too"),
        (3, "--labels", "clean_0.jpg: this kind of picture holds no labels, wanted a PNG"),
    ):
        _, found, err = _localized(scene, capsys, *options.split(), pano="images/clean_0.jpg")
        assert (found, message in err) == (code, True)


def test_prepared_map_of_labels_wants_labels(scene, tmp_path, capsys):
    built = str(tmp_path / "scan.map")
    cloud = ["--cloud", str(scene / "cloud.ply")]
    assert prepare_map.main([*cloud, "--labels", "--out", built, "--quiet"]) == 0
    capsys.readouterr()
    pano = ["--pano", str(scene / "labels" / "clean_0.png"), "--quiet"]
    localize.main(["--cloud", built, *pano, "--labels"])
    of_map = Result.from_json(capsys.readouterr().out)
    of_cloud, _, _ = _localized(scene, capsys, "--labels")
    np.testing.assert_array_equal(of_map.pose.center_world, of_cloud.pose.center_world)
    assert localize.main(["--cloud", built, *pano]) == 3
    assert "scan.map: found a prepared map of labels, wanted --labels too" in capsys.readouterr().err
    assert localize.main(["--cloud", str(rooms.map_path(1)), *pano, "--labels"]) == 3
    assert ".map: found a prepared map of colours, wanted no --labels" in capsys.readouterr().err


def test_evaluation_takes_the_pictures_of_labels(scene, tmp_path, capsys):
    words = ["--quiet", "--labels", "--preset", "default", "max_starts=100"]
    assert evaluate.main(["--scenes", str(scene), "--out", str(tmp_path / "run.jsonl"), *words]) == 0
    (row,) = read_run(tmp_path / "run.jsonl")[0]
    assert row.result.pano == str(scene / "labels" / "clean_0.png")
    text = (scene / "queries.json").read_text()
    (scene / "unlabelled.json").write_text(text.replace('"labels"', '"unknown"'))
    unlabelled = ["--scenes", str(scene / "unlabelled.json"), "--out", str(tmp_path / "none.jsonl")]
    assert evaluate.main([*unlabelled, *words]) == 3
    assert "images/clean_0.jpg has no labels in queries.json" in capsys.readouterr().err
