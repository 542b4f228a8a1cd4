"""The API: what options mean, and what is refused. docs/API.md and examples/ are run by test_examples.py."""

import dataclasses
import hashlib
import inspect
import re
from typing import get_args

import numpy as np
import pytest
import rooms

import piccolo
from piccolo.files.cache import sha256_of_arrays
from piccolo.geometry.rotations import heading_pitch_roll_deg
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.paper.settings import PaperSettings
from piccolo.scan import PhotoOptions
from piccolo.scan_map.prior import Prior


@pytest.fixture(scope="module")
def scan():
    cloud = rooms.room(1)[1]
    return piccolo.open_scan(cloud.points + cloud.origin_world, cloud.colors)


def test_options_that_are_none_are_named(scan):
    points = np.zeros((2, 3))
    for options, error, text in (
        ({"foo": 3}, TypeError, "unexpected keyword argument 'foo'"),
        ({"units": "inch"}, piccolo.InputError, "`units`: found 'inch', wanted one of mm, cm, m"),
        ({"up": "w"}, piccolo.InputError, "`up`: found 'w', wanted one of auto, z"),
        ({"num_threads": 0}, piccolo.InputError, "`num_threads`: found 0"),
    ):
        with pytest.raises(error, match=text):
            piccolo.open_scan(points, points, **options)
    with pytest.raises(piccolo.InputError, match="found no file"):
        piccolo.open_scan([])
    for options, error, text in (
        ({"foo": 3}, TypeError, "unexpected keyword argument 'foo'"),
        ({"gravity": "Known"}, piccolo.InputError, "`gravity`: found 'Known', wanted one of auto"),
        ({"mask": np.ones((3, 3), bool)}, piccolo.InputError, "mask: wanted an array"),
        ({"fov_deg": 90.0}, piccolo.InputError, "need a file"),
        ({"gravity_vector": (0.0, 0.0, 0.0)}, piccolo.InputError, "`gravity_vector`: found .*, wanted three"),
    ):
        with pytest.raises(error, match=text):
            scan.localize(np.zeros((64, 128, 3), np.uint8), **options)
    with pytest.raises(piccolo.InputError, match=r"`mask`: found bool of shape \(3, 3\), wanted a path"):
        scan.track(mask=np.zeros((3, 3), bool))
    with pytest.raises(piccolo.InputError, match="panorama: found float64 of shape"):
        scan.localize(np.zeros((64, 128, 3)))


def test_a_mask_is_left_out_and_settings_are_repeated(scan):
    image, true_pose = rooms.scene(1)[1].rgb, rooms.query(1).pose
    mask = np.zeros(image.shape[:2], bool)
    mask[-20:] = True
    spoilt = np.where(mask[..., None], np.uint8(255), image)
    heading_deg = heading_pitch_roll_deg(true_pose)[0] + 20.0
    prior = {"heading_deg": heading_deg, "heading_tolerance_deg": 30.0}
    result = scan.localize(spoilt, mask=mask, gravity="known", **prior)
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
        assert piccolo.open_scan(path, **options)._opened.prepared.scan_sha256 == expected
    digest = scan._opened.prepared.scan_sha256
    assert digest == sha256_of_arrays(cloud.points + cloud.origin_world, cloud.colors)
    assert len({digest, sha256_of_arrays(cloud.points), sha256_of_arrays(cloud.points.T.copy())}) == 3


def test_a_signature_shows_every_option():
    options = inspect.signature(piccolo.open_scan).parameters
    assert {"labels", "ignore_labels", "units", "crs", "settings"} <= options.keys()
    for method in (piccolo.Scan.localize, piccolo.Scan.localize_many):
        signature = inspect.signature(method)
        assert get_args(signature.parameters["options"].annotation) == (PhotoOptions,)
        own = {p.name for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY}
        assert len((own - {"relative_scale"}) | PhotoOptions.__annotations__.keys()) == 20
    section = piccolo.Scan.localize.__doc__.split("Returns")[0]
    assert all(re.search(rf"^ {{8}}(\w+, )?{name}\b", section, re.M) for name in PhotoOptions.__annotations__)
    assert not [name for name in dir(piccolo.Scan) if name in ("prepared", "workers", "settings", "walk")]
    assert all(getattr(piccolo, name) is not None for name in piccolo.__all__)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"height": 1.5}, "`height`: found 1.5, wanted 2 numbers"),
        ({"near_world": (1, 2), "radius": 1.0}, r"`near_world`: found \(1, 2\), wanted 3 numbers"),
        ({"within": "x"}, "`within`: found 'x', wanted a list, each a text"),
        ({"heading_deg": "12"}, "`heading_deg`: found '12', wanted a number"),
        ({"use_gps": 1}, "`use_gps`: found 1, wanted True or False"),
        ({"solver": "newton"}, "`solver`: found 'newton', wanted one of"),
        ({"camera": 3}, "`camera`: found 3, wanted a path"),
    ],
)
def test_an_option_of_another_type_is_refused(scan, options, text):
    with pytest.raises(piccolo.InputError, match=text):
        scan.localize("a.jpg", **options)
    with pytest.raises(piccolo.InputError, match=text):
        scan.localize_many([], **options)
    with pytest.raises(piccolo.InputError, match=text):
        scan.track(**options)


def test_an_option_that_a_method_does_not_have_is_refused(scan):
    wrong = (
        (scan.localize, ("a.jpg",), "near"),
        (scan.localize_many, ([],), "near"),
        (scan.track, (), "refine_focal"),
        (scan.localize_walk, ([],), "refine_focal"),
        (scan.occlusion_mask, ("a.jpg", None), "gravity"),
    )
    for method, arguments, name in wrong:
        text = rf"{method.__qualname__}\(\) got an unexpected keyword argument '{name}'"
        with pytest.raises(TypeError, match=text):
            method(*arguments, **{name: True})
    with pytest.raises(piccolo.InputError, match=r"`mask`: found .*, wanted a path"):
        scan.track(mask=np.zeros((4, 8), bool))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"units": ["m"]}, r"`units`: found \['m'\], wanted one of mm"),
        ({"settings": "paper"}, "`settings`: found 'paper', wanted CoarseToFineSettings or PaperSettings"),
        ({"crs": 12}, "`crs`: found 12, wanted a text"),
        ({"num_threads": "2"}, "`num_threads`: found '2', wanted a whole number"),
        ({"colors": [1, 2, 3]}, "`colors`: found .*, wanted an array"),
        ({"colors": np.zeros((1, 3))}, "colors: found shapes"),
        ({"ignore_labels": [1]}, "`ignore_labels`: only with `labels`"),
        ({"progress": 1}, "`progress`: found 1, wanted a function"),
    ],
)
def test_an_option_of_a_scan_of_another_type_is_refused(options, text):
    with pytest.raises(piccolo.InputError, match=text):
        piccolo.open_scan(np.zeros((2, 3)), **{"colors": np.zeros((2, 3))} | options)
    with pytest.raises(piccolo.InputError, match="`source`: found 3, wanted"):
        piccolo.open_scan(3)


def test_a_saved_scan_gives_the_same_bits(tmp_path, scan):
    image = rooms.query(1).rgb
    scan.save(tmp_path / "room.map")
    again = piccolo.open_scan(tmp_path / "room.map").localize(image)
    result = scan.localize(image)
    assert again.pose.key == result.pose.key
    assert (again.confidence, again.loss) == (result.confidence, result.loss)
    assert np.array_equal(again.covariance.matrix, result.covariance.matrix)
    partial_map = dataclasses.replace(scan._opened.prepared, is_partial=True)
    partial = piccolo.Scan(dataclasses.replace(scan._opened, prepared=partial_map))
    with pytest.raises(piccolo.InputError, match="prepared within `near_world` only"):
        partial.save(tmp_path / "part.map")
    cloud = rooms.room(1)[1]
    paper = piccolo.open_scan(cloud.points, cloud.colors, settings=PaperSettings())
    with pytest.raises(piccolo.InputError, match="found a scan of the preset paper"):
        paper.save(tmp_path / "paper.map")
    assert [path.name for path in tmp_path.iterdir()] == ["room.map"]


def test_a_photos_prior_is_added_to_that_of_the_scan(tmp_path, scan):
    settings = CoarseToFineSettings(prior=Prior(height=(1.0, 2.0)))
    opened = piccolo.Scan(dataclasses.replace(scan._opened, settings=settings))
    (result,) = opened.localize_many([tmp_path / "none.jpg"], gravity_vector=np.array([0.0, 0.0, -1.0]))
    prior = Prior(height=(1.0, 2.0), gravity_vector=(0.0, 0.0, -1.0))
    assert result.settings["prior"] == dataclasses.asdict(prior)


def test_a_photo_that_cannot_be_read_is_a_result_among_many(tmp_path, scan):
    (tmp_path / "bad.jpg").write_bytes(b"no picture")
    results = list(scan.localize_many([tmp_path / "bad.jpg", rooms.query(1).rgb], gravity="known"))
    assert [result.status for result in results] == ["unreadable", "localized"]
    assert str(tmp_path / "bad.jpg") in results[0].error
    assert results[0].source.pano_sha256 == hashlib.sha256(b"no picture").hexdigest()
    assert results[0].settings["gravity"] == "known"
