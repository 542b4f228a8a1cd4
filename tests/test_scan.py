"""The API: what options mean, and what is refused. docs/API.md and examples/ are run by test_examples.py."""

import hashlib

import numpy as np
import pytest
import rooms

import piccolo
from piccolo.files.cache import sha256_of_arrays
from piccolo.paper.settings import PaperSettings


@pytest.fixture(scope="module")
def scan():
    cloud = rooms.room(1)[1]
    return piccolo.open_scan(cloud.points + cloud.origin_world, cloud.colors)


def test_options_that_are_none_are_named(scan):
    points = np.zeros((2, 3))
    for options, error, text in (
        ({"foo": 3}, TypeError, "unexpected keyword argument 'foo'"),
        ({"units": "inch"}, piccolo.InputError, "units: found 'inch', wanted one of mm, cm, m"),
        ({"up": "w"}, piccolo.InputError, "up: found 'w', wanted one of auto, z"),
        ({"num_threads": 0}, piccolo.InputError, "num_threads: found 0"),
    ):
        with pytest.raises(error, match=text):
            piccolo.open_scan(points, points, **options)
    with pytest.raises(piccolo.InputError, match="found no file"):
        piccolo.open_scan([])
    for options, error, text in (
        ({"foo": 3}, TypeError, "found no option 'foo', wanted one of mask, mask_nadir_deg"),
        ({"gravity": "Known"}, piccolo.InputError, "gravity: found 'Known', wanted one of auto"),
        ({"mask": np.ones((3, 3), bool)}, piccolo.InputError, "mask: wanted an array"),
        ({"fov_deg": 90.0}, piccolo.InputError, "go with files"),
    ):
        with pytest.raises(error, match=text):
            scan.localize(np.zeros((64, 128, 3), np.uint8), **options)
    with pytest.raises(piccolo.InputError, match="mask: found an array, wanted the path"):
        scan.track(mask=np.zeros((3, 3), bool))
    with pytest.raises(piccolo.InputError, match="panorama: found float64 of shape"):
        scan.localize(np.zeros((64, 128, 3)))


def test_a_mask_is_left_out_and_settings_are_repeated(scan):
    image, true_pose = rooms.scene(1)[1].rgb, rooms.query(1).pose
    mask = np.zeros(image.shape[:2], bool)
    mask[-20:] = True
    spoilt = np.where(mask[..., None], np.uint8(255), image)
    result = scan.localize(spoilt, mask=mask, gravity="known", heading_tolerance_deg=30.0)
    assert rooms.errors(result.pose, true_pose)[0] < 0.02
    assert result.storey == 1
    assert result.height_above_floor == pytest.approx(true_pose.center_world[2], abs=0.05)
    assert result.settings["gravity"] == "known"
    assert result.settings["prior"]["heading_tolerance_deg"] == 30.0
    assert len(repr(scan)) < 1000


def test_a_scan_is_known_by_its_bytes(tmp_path, scan):
    """A file's digest is that of sha256sum; of arrays it changes with type and shape."""
    cloud, path = rooms.room(1)[1], tmp_path / "a.txt"
    np.savetxt(path, np.hstack([cloud.points[::50], cloud.colors[::50]]), fmt="%.3f")
    expected = hashlib.sha256(path.read_bytes()).hexdigest()
    for options in ({"cache": False}, {"settings": PaperSettings()}):
        assert piccolo.open_scan(path, **options).prepared.scan_sha256 == expected
    digest = scan.prepared.scan_sha256
    assert digest == sha256_of_arrays(cloud.points + cloud.origin_world, cloud.colors)
    assert len({digest, sha256_of_arrays(cloud.points), sha256_of_arrays(cloud.points.T.copy())}) == 3
