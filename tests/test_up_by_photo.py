"""Up of a scan by what is beside its points, a photo or scanner poses, from the file to the transform."""

import json

import numpy as np
import pytest
from pictures import encoded
from rooms import query, room
from scans import bare_room
from test_cloud_ptx import scan as ptx_lines
from test_cloud_ptx import write as write_lines

from piccolo.cli import align_gravity, up_by_photo
from piccolo.coarse_to_fine import aligned_cloud as mapping
from piccolo.geometry.pose import exp_so3
from piccolo.gravity.up import Hypothesis, Up
from piccolo.runtime.threads import Workers

FLIP = np.diag([1.0, -1.0, -1.0])


def test_a_photo_tells_that_a_scan_is_upside_down(tmp_path, capsys):
    """A furnished room, turned over: the photo is localized under one of the two senses only."""
    cloud = room(1)[1]
    points = (cloud.points + cloud.origin_world) @ FLIP.T
    np.savetxt(tmp_path / "scan.xyz", np.hstack([points, cloud.colors]), "%.4f")
    (tmp_path / "photo.png").write_bytes(encoded(query(1).rgb, ".png"))
    files = ["--cloud", str(tmp_path / "scan.xyz"), "--pano", str(tmp_path / "photo.png"), "--transform-only"]
    assert align_gravity.main([*files, "--assume-nothing", "--quiet"]) == 0
    report = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(report["up_scan"], [0.0, 0.0, -1.0], atol=np.radians(0.3))
    assert "is localized under this of" in report["explanation"]
    assert report["confidence"] > 0.9
    assert len(report["hypotheses"]) >= 2


def test_the_scanners_of_a_file_tell_up_in_a_bare_room(tmp_path, capsys):
    R = exp_so3(np.array([1.4, 0.6, -0.3]))
    points = bare_room() @ R.T
    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = R.T, R @ [2.0, 2.0, 1.5]
    path = write_lines(tmp_path / "a.ptx", ptx_lines(points, np.full(points.shape, 128), matrix))
    assert align_gravity.main(["--cloud", str(path), "--transform-only", "--assume-nothing", "--quiet"]) == 0
    report = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(report["up_scan"], R[:, 2], atol=np.radians(0.3))
    assert report["hypotheses"][0]["evidence"]["stations"] > 5.0


def test_a_photo_that_is_none_is_refused_before_the_cloud_is_read(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(align_gravity, "open_cloud", lambda *_: pytest.fail("the cloud was opened"))
    (tmp_path / "text.jpg").write_text("no picture")
    (tmp_path / "scan.ply").write_text("never read")
    for name in ("no such photo.jpg", "text.jpg"):
        files = ["--cloud", tmp_path / "scan.ply", "--pano", tmp_path / name, "--out", tmp_path / "out.ply"]
        assert align_gravity.main([*map(str, files), "--quiet"]) == 3
        out, err = capsys.readouterr()
        assert out == ""
        assert err.count("\n") == 1
        assert name in err
    assert {path.name for path in tmp_path.iterdir()} == {"text.jpg", "scan.ply"}
    photo = ["--pano", tmp_path / "a.ply", "--out", tmp_path / "a.ply"]
    (tmp_path / "a.ply").write_text("")
    assert align_gravity.main(["--cloud", str(tmp_path / "scan.ply"), *map(str, photo)]) == 2
    assert "found an input as the output" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("statuses", "chosen"),
    [
        (("not_localized", "localized"), 1),
        (("localized", "localized"), None),
        (("not_localized", "ambiguous"), None),
    ],
)
def test_exactly_one_sense_must_be_localized(monkeypatch, tmp_path, statuses, chosen):
    senses = [np.array([0.0, 0.0, z]) for z in (1.0, -1.0)]
    hypotheses = [Hypothesis(up, p, {}) for up, p in zip(senses, (0.6, 0.4), strict=True)]
    found = Up(senses[0], 0.6, "by its planes", tuple(hypotheses))
    outcomes = iter([(status, 0.95) for status in statuses])
    monkeypatch.setattr(up_by_photo, "_localized", lambda *_: next(outcomes))
    settled = up_by_photo.settle_by_photo(found, None, tmp_path / "a.jpg", Workers(1))
    if chosen is None:
        assert settled.confidence == 0.6
        assert settled.reason.startswith("by its planes; ")
        assert "settles nothing: " in settled.reason
    else:
        assert (settled.direction_world == senses[chosen]).all()
        assert settled.confidence == 0.95


def test_z_in_doubt_is_kept_and_said(monkeypatch):
    octree = type("Octree", (), {"level": lambda self, size: np.zeros((1, 6))})()
    monkeypatch.setattr(mapping, "estimate_normals", lambda points: None)
    for confidence, is_kept in ((0.5, True), (0.99, False)):
        up = Up(np.array([1.0, 0.0, 0.0]), confidence, "", ())
        monkeypatch.setattr(mapping, "find_up", lambda cloud, up=up: up)
        R, (warning,) = mapping.align_to_gravity(octree)
        assert np.array_equal(R, np.eye(3)) == is_kept
        assert ("z is kept, --up sets another" in warning) == is_kept
        assert "the cloud's z is 90 deg off its up direction" in warning
