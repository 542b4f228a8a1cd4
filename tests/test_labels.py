"""Semantic labels in place of colours, of the paper's experiment."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from plyfile import PlyData
from refusals import assert_refused
from rooms import write_room
from scipy.spatial.distance import pdist

from piccolo.photo.panorama import read_panorama
from piccolo.system.errors import InputError
from research.experiments.labels import (
    NUM_COLORS,
    label_colors,
    palette,
    read_labelled_points,
    read_labels,
)
from research.experiments.reproduce_paper import show_labels
from research.scene import read_scene
from research.synthetic.layout import LABEL_NAMES

pytestmark = pytest.mark.research

TIER = "scene"

RGB = ("red", "green", "blue")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A room with labels, and one panorama."""
    words = "--seed 7 --width 512 --points 60000 --panoramas 1 --labels"
    return read_scene(write_room(tmp_path_factory.mktemp("labels"), words))


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


def test_room_maker_labels_points_and_pixels_alike(scene):
    (query,) = scene.queries
    picture = read_labels(query.labels)
    points, labels = read_labelled_points(scene.cloud)
    x, y, z = query.pose.R_cam_from_world @ (points - query.pose.center_world).T
    column = (512 * (0.5 - np.arctan2(y, x) / (2 * np.pi))).astype(int) % 512
    row = (512 * (0.25 - np.arctan2(z, np.hypot(x, y)) / (2 * np.pi))).astype(int)
    assert (picture[row, column] == labels).mean() > 0.7  # the rest is hidden
    assert set(np.unique(picture)) <= set(range(1, len(LABEL_NAMES)))
    for kind, side in (("floor", points[:, 2] < 0.02), ("ceiling", points[:, 2] > 2.48)):
        assert (labels[side] == LABEL_NAMES.index(kind)).mean() > 0.3
    assert (picture[[0, -1]] == [[LABEL_NAMES.index("ceiling")], [picture[-1, 0]]]).all()


def test_a_scene_shows_its_labels_and_nothing_is_masked(scene, tmp_path):
    shown = show_labels(scene, tmp_path)
    points, labels = read_labelled_points(scene.cloud)
    vertices = PlyData.read(shown.cloud)["vertex"]
    columns = [np.stack([vertices[name] for name in names], axis=1) for names in ("xyz", RGB)]
    np.testing.assert_array_equal(columns[0], points)
    np.testing.assert_array_equal(columns[1], label_colors(labels))
    (query,) = shown.queries
    panorama = read_panorama(query.image)
    np.testing.assert_array_equal(panorama.rgb, label_colors(read_labels(scene.queries[0].labels)))
    assert np.argwhere(~panorama.is_valid).tolist() == [[0, 0], [255, 0]], "the floor is no disc of a tripod"
    assert panorama.warnings == ()
    assert query.pose == scene.queries[0].pose


def test_what_has_no_labels_is_refused(scene, tmp_path):
    (query,) = scene.queries
    bare = replace(scene, queries=(replace(query, labels=None),))
    with pytest.raises(InputError, match=r"images/clean_0\.jpg has no labels in queries.json"):
        show_labels(bare, tmp_path)
    rgb = tmp_path / "rgb.png"
    cv2.imwrite(str(rgb), np.zeros((64, 128, 3), np.uint8))
    assert_refused("found no labels, wanted a PNG of one channel, W = 2 H", read_labels, rgb)
