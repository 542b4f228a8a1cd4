"""The API: what options mean, and what is refused. docs/API.md and examples/ are run by test_documents.py."""

import dataclasses
import hashlib
import inspect
import re

import numpy as np
import pytest
import rooms
from refusals import assert_input_error

import piccolo
from piccolo.geometry.pose import heading_pitch_roll_deg
from piccolo.localization.paper import PaperSettings
from piccolo.photo.photo import Prior
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.system.errors import InputError
from piccolo.system.files.cache import sha256_of_arrays

TIER = "scene"


@pytest.fixture(scope="module")
def scan():
    cloud = rooms.room(1)[1]
    return piccolo.open_scan(piccolo.Cloud(cloud.points + cloud.origin_world, colors=cloud.colors))


def test_options_that_are_none_are_named(scan):
    assert_input_error("`num_threads`: found 0", lambda: piccolo.open_scan(np.zeros((2, 3)), num_threads=0))
    for call, error, text in (
        (lambda: piccolo.open_scan("a.ply", foo=3), TypeError, "unexpected keyword argument 'foo'"),
        (lambda: scan.localize("a.jpg", near=3), TypeError, "unexpected keyword argument 'near'"),
        (lambda: piccolo.Photo("a.jpg", near=3), TypeError, "unexpected keyword argument 'near'"),
        (lambda: piccolo.Prior(mask=3), TypeError, "unexpected keyword argument 'mask'"),
        (lambda: scan.localize("a.jpg", gravity="Known"), InputError, "`gravity`: found 'Known', wanted one"),
        (lambda: scan.localize("a.jpg", prior=3), InputError, "`prior`: found 3, wanted Prior"),
        (lambda: scan.localize_many([], min_confidence=2), InputError, "`min_confidence`: found 2"),
        (lambda: scan.track(motion=2.0), InputError, "`motion`: found 2.0, wanted Motion"),
    ):
        with pytest.raises(error, match=text):
            call()


PIXELS = np.zeros((64, 128, 3), np.uint8)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: piccolo.Photo(PIXELS, mask=np.ones((3, 3), bool)), "`mask`: found bool of shape .*, wanted"),
        (lambda: piccolo.Photo("a.jpg", mask=np.ones((3, 3), bool)), "`mask`: found an array .*, wanted a p"),
        (lambda: piccolo.Photo(PIXELS, fov_deg=90.0), "found an array as picture, wanted a file"),
        (lambda: piccolo.Photo(PIXELS, mask="mask.png"), "found an array as picture, wanted a file"),
        (lambda: piccolo.Photo(np.zeros((64, 128, 3))), "`picture`: found float64 of shape"),
        (lambda: piccolo.Photo("a.jpg", gravity_vector=(0, 0, 0)), "`gravity_vector`: found .*, wanted th"),
        (lambda: piccolo.Photo("a.jpg", camera=3), "`camera`: found 3, wanted a path"),
        (lambda: piccolo.Photo("a.jpg", camera="none.json"), "none.json: "),
        (lambda: piccolo.Photo("a.jpg", camera="a.json", rig="b.json"), "`camera`, `rig`: found both"),
        (lambda: piccolo.Photo("a.jpg", refine_focal=1), "`refine_focal`: found 1, wanted True or False"),
        (lambda: piccolo.Prior(height=1.5), "`height`: found 1.5, wanted 2 numbers"),
        (lambda: piccolo.Prior(near=(1, 2), radius=1.0), r"`near`: found \(1, 2\), wanted 3 numbers"),
        (lambda: piccolo.Prior(near=(1, 2, 3)), "`near`, `radius`: found one of them, wanted both or none"),
        (lambda: piccolo.Prior(within="x"), "`within`: found 'x', wanted a list, each a text"),
        (lambda: piccolo.Prior(heading_deg="12"), "`heading_deg`: found '12', wanted a number"),
        (lambda: piccolo.Prior(use_gps=1), "`use_gps`: found 1, wanted True or False"),
        (lambda: piccolo.Prior(height=(2.0, 1.0)), r"`height`: found \[2.0, 1.0\], wanted MIN below MAX"),
    ],
)
def test_an_option_is_checked_when_the_object_is_made(make, text):
    with pytest.raises(piccolo.InputError, match=text) as error:
        make()
    assert "\n" not in str(error.value)


def test_a_mask_is_left_out_and_settings_are_repeated(scan):
    image, true_pose = rooms.scene(1)[1].rgb, rooms.query(1).pose
    mask = np.zeros(image.shape[:2], bool)
    mask[-20:] = True
    spoilt = np.where(mask[..., None], np.uint8(255), image)
    heading_deg = heading_pitch_roll_deg(true_pose)[0] + 20.0
    prior = piccolo.Prior(heading_deg=heading_deg, heading_tolerance_deg=30.0)
    result = scan.localize(piccolo.Photo(spoilt, mask=mask), prior=prior, gravity="known")
    assert rooms.errors(result.pose, true_pose)[0] < 0.02
    assert result.storey == 1
    assert result.height_above_floor == pytest.approx(true_pose.center_world[2], abs=0.05)
    assert result.settings["gravity"] == "known"
    assert result.settings["prior"]["heading_tolerance_deg"] == 30.0
    assert len(repr(scan)) < 1000


def test_a_scan_is_known_by_its_bytes(tmp_path, scan):
    """A file's digest is that of sha256sum; of arrays it changes with type and shape."""
    cloud = rooms.room(1)[1]
    path = tmp_path / "a.txt"
    np.savetxt(path, np.hstack([cloud.points[::50], cloud.colors[::50]]), fmt="%.3f")
    expected = hashlib.sha256(path.read_bytes()).hexdigest()
    for options in ({"cache": False}, {"settings": PaperSettings()}):
        assert piccolo.open_scan(path, **options).prepared.scan_sha256 == expected
    digest = scan.prepared.scan_sha256
    assert digest == sha256_of_arrays(cloud.points + cloud.origin_world, cloud.colors)
    assert len({digest, sha256_of_arrays(cloud.points), sha256_of_arrays(cloud.points.T.copy())}) == 3


def _public_functions():
    """All functions and methods that the documents name; options are objects, which are made by name."""
    for name in piccolo.__all__:
        value = getattr(piccolo, name)
        if inspect.isfunction(value):
            yield name, value
        elif inspect.isclass(value):
            for method, function in inspect.getmembers(value, inspect.isfunction):
                if not method.startswith("_"):
                    yield f"{name}.{method}", function


def test_no_public_function_has_more_than_six_parameters():
    signatures = {name: inspect.signature(function) for name, function in _public_functions()}
    assert {"open_scan", "write_report", "Scan.localize_bundle", "Walk.add"} <= signatures.keys()
    for name, signature in signatures.items():
        kinds = {p.kind for p in signature.parameters.values()}
        assert len(signature.parameters.keys() - {"self"}) <= 6, name
        assert not kinds & {inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL}, name


@pytest.mark.parametrize(
    "kind",
    [
        piccolo.Photo,
        piccolo.Prior,
        piccolo.Cloud,
        piccolo.Motion,
        piccolo.RelativePoses,
        piccolo.ReportSettings,
    ],
)
def test_each_option_is_described_where_it_is_given(kind):
    section = kind.__doc__.split("Parameters")[1].split("Raises")[0]
    for name in inspect.signature(kind).parameters:
        assert re.search(rf"^ {{4}}(\w+, )?{name}\b", section, re.MULTILINE), name
    assert not [name for name in dir(piccolo.Scan) if name in ("prepared", "workers", "settings", "walk")]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"source": 3}, "`source`: found 3, wanted a path"),
        ({"source": [], "colors": None}, "`source`: found no file"),
        ({"units": "inch"}, "`units`: found 'inch', wanted one of mm, cm, m"),
        ({"up": "w"}, "`up`: found 'w', wanted one of auto, z"),
        ({"units": ["m"]}, r"`units`: found \['m'\], wanted one of mm"),
        ({"settings": "paper"}, "`settings`: found 'paper', wanted CoarseToFineSettings or PaperSettings"),
        ({"crs": 12}, "`crs`: found 12, wanted a text"),
        ({"num_threads": "2"}, "`num_threads`: found '2', wanted a whole number"),
        ({"colors": [1, 2, 3]}, "`colors`: found .*, wanted an array"),
        ({"colors": np.zeros((1, 3))}, "colors: found shapes"),
        ({"progress": 1}, "`progress`: found 1, wanted a function"),
    ],
)
def test_an_option_of_a_scan_of_another_type_is_refused(options, text):
    known = inspect.signature(piccolo.Cloud).parameters
    arrays = {"source": np.zeros((2, 3)), "colors": np.zeros((2, 3))}
    of_cloud = arrays | {name: value for name, value in options.items() if name in known}
    others = {name: value for name, value in options.items() if name not in known}
    assert_input_error(text, lambda: piccolo.open_scan(piccolo.Cloud(**of_cloud), **others))


def test_a_saved_scan_gives_the_same_bits(tmp_path, scan):
    image = rooms.query(1).rgb
    scan.save(tmp_path / "room.map")
    again = piccolo.open_scan(tmp_path / "room.map").localize(image)
    result = scan.localize(image)
    assert again.pose.key == result.pose.key
    assert (again.confidence, again.loss) == (result.confidence, result.loss)
    assert np.array_equal(again.covariance.matrix, result.covariance.matrix)
    partial_map = dataclasses.replace(scan.prepared, is_partial=True)
    partial = dataclasses.replace(scan, prepared=partial_map)
    assert_input_error("prepared within `near` only", partial.save, tmp_path / "part.map")
    cloud = rooms.room(1)[1]
    paper = piccolo.open_scan(piccolo.Cloud(cloud.points, colors=cloud.colors), settings=PaperSettings())
    assert_input_error("found a scan of the preset paper", paper.save, tmp_path / "paper.map")
    assert [path.name for path in tmp_path.iterdir()] == ["room.map"]


def test_each_of_many_photos_has_its_own_options_and_prior(tmp_path, scan):
    settings = CoarseToFineSettings(prior=Prior(height=(1.0, 2.0)), gravity="known")
    opened = dataclasses.replace(scan, settings=settings)
    own = Prior(near=(1.0, 2.0, None), radius=3.0)
    photos = [
        piccolo.Photo(tmp_path / "a.jpg", gravity_vector=np.array([0.0, 0.0, -1.0])),
        piccolo.Photo(tmp_path / "b.jpg", focal_px=300),
    ]
    first, second = opened.localize_many(photos, prior=[None, own])
    assert first.settings["prior"] == dataclasses.asdict(Prior(height=(1.0, 2.0)))
    assert first.settings["panorama"]["gravity_vector"] == (0.0, 0.0, -1.0)
    assert second.settings["prior"] == dataclasses.asdict(own)
    assert second.settings["panorama"]["focal_px"] == 300
    assert {r.settings["gravity"] for r in (first, second)} == {"known"}
    with pytest.raises(InputError, match="`prior`: found 1 of 2 photos, wanted one of each photo"):
        opened.localize_many(photos, prior=[own])


@pytest.mark.parametrize("option", [{"refine_focal": True}, {"gravity_vector": (0.0, 0.0, -1.0)}])
def test_the_paper_refuses_what_it_would_ignore(option):
    cloud = rooms.room(1)[1]
    colored = piccolo.Cloud(cloud.points, colors=cloud.colors)
    paper = piccolo.open_scan(colored, settings=PaperSettings(num_translations=1))
    with pytest.raises(InputError, match=f"`{next(iter(option))}`: not an option of the preset paper"):
        paper.localize(piccolo.Photo(rooms.query(1).rgb, **option))
    with pytest.raises(InputError, match="`prior`: not an option of the preset paper"):
        paper.localize(rooms.query(1).rgb, prior=Prior())
    assert_input_error("walks: not available with the preset paper", paper.track)
    with pytest.raises(InputError, match="`relative_poses`: not available with the preset paper"):
        paper.localize_bundle(["a.jpg"], [rooms.query(1).pose])


def test_a_photo_that_cannot_be_read_is_a_result_among_many(tmp_path, scan):
    (tmp_path / "bad.jpg").write_bytes(b"no picture")
    results = list(scan.localize_many([tmp_path / "bad.jpg", rooms.query(1).rgb], gravity="known"))
    assert [result.status for result in results] == ["unreadable", "localized"]
    assert str(tmp_path / "bad.jpg") in results[0].error
    assert results[0].source.pano_sha256 == hashlib.sha256(b"no picture").hexdigest()
    assert results[0].settings["gravity"] == "known"
