"""Command line, Python and service say the same of the same photos, to the bit."""

import json
from pathlib import Path

import numpy as np
import pytest
import rooms
from camera_room import DENSE, SEED, TRUE, place
from pictures import encoded, write
from poses import result
from services import serving

import piccolo
from piccolo.api.result_files import read_results
from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.cli.localize import main
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.photo.camera import Mount
from piccolo.photo.camera.model import pinhole
from piccolo.poses.relative_poses import read_relative_poses
from piccolo.system.jobs.threads import Workers
from piccolo.together.coloring import painting
from research.synthetic.world import render_picture

TIER = "scene"

FOCAL = 1.03 * TRUE  # as it is told, 3 % too long
TURNS = (0.5, 1, 2, 5)  # of the photos, in quarters of a radian
NEAR = 0.3  # [m] around the place of the photos
COLOR = "photo {}.png"


def _untimed(text):
    """A result as a dictionary, but for its times."""
    return json.loads(text) | {"seconds": None}


def _lines(path):
    return [_untimed(line) for line in path.read_text().splitlines()]


def _poses():
    """The poses of narrow photos, one after another."""
    pose = place(1)[1]
    turned = [yaw_rotation(0.25 * k) @ pose.R_cam_from_world for k in TURNS]
    offsets = [np.array([0.02 * k, 0.03, 0.0]) for k in TURNS]
    return [Pose(R, pose.center_world + offset) for R, offset in zip(turned, offsets, strict=True)]


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Narrow photos of one camera."""
    folder = tmp_path_factory.mktemp("doors")
    for k, pose in enumerate(_poses()):
        picture = render_picture(Mount(pinhole(320, 240, TRUE)), place(1)[0], pose, Workers(2))
        write(folder / f"{k}.png", encoded(picture, ".png"))
    return sorted(folder.iterdir())


def _assert_right(results):
    """The focal length that others told a photo is right, and so are poses that are sure."""
    told = [one.focal_length.others_px for one in results if one.focal_length and one.focal_length.others_px]
    assert told
    assert told == pytest.approx([TRUE] * len(told), rel=0.01)
    for one, true in zip(results, _poses(), strict=True):
        if one.status == "localized":
            assert one.pose.distance(true) < 0.05


@pytest.mark.process
@pytest.mark.usefixtures("searched_once")
def test_photos_of_one_camera(photos, tmp_path):
    """Three say together what their focal length is; with that the fourth is looked at again beside them.

    Command and Python ask for the same searches, which are made once; the service makes them itself.
    """
    cloud = str(rooms.map_path(SEED, DENSE))
    out = tmp_path / "poses.jsonl"
    near = (*place(1)[1].center_world.tolist(), NEAR)
    words = ["--cloud", cloud, "--pano", *map(str, photos), "--focal", str(FOCAL), "--gravity", "known"]
    words += ["--near", *map(str, near), "--quiet", "--out", str(out)]
    main(words)
    expected = _lines(out)
    assert [line["beside"] and len(line["beside"]["photos"]) for line in expected] == [None, None, None, 2]
    results = read_results([out])
    _assert_right(results)
    main(words)
    assert read_results([out]) == results, "nothing is left to do"
    scan = piccolo.open_scan(cloud)
    prior = piccolo.Prior(near=near[:3], radius=near[3])
    given = [piccolo.Photo(str(photo), focal_px=FOCAL) for photo in photos]
    found = scan.localize_many(given, prior=prior, gravity="known")
    assert [_untimed(r.to_json()) for r in found] == expected
    (alone,) = scan.localize_many(iter(given[:1]), prior=prior, gravity="known")
    told = expected[0]["focal_length"]["doubt"]
    assert alone.focal_length.doubt != told, "of an iterator each is localized by itself"
    pictures = {photo.name: photo.read_bytes() for photo in photos}
    prior = {"near": near[:3], "radius": near[3]}
    options = {"photo": {"focal_px": FOCAL}, "prior": prior, "gravity": "known"}
    with serving("--cloud", cloud, "--jobs", "1") as client:
        status, _, body = client.post_all("/localize", pictures, options)
    assert status == 200
    answers = list(map(_untimed, body.decode().splitlines()))
    for answer, line in zip(answers, expected, strict=True):
        beside = line["beside"] and answer["beside"] | {
            "photos": [str(photos[0].parent / name) for name in answer["beside"]["photos"]],
            "asked_sha256": line["beside"]["asked_sha256"],  # of the names, too
        }
        assert answer | {"pano": line["pano"], "beside": beside} == line


def test_a_bundle_a_walk_and_a_colouring(tmp_path, coarse_colors, monkeypatch):
    """One round of colours tells doors apart as well as two."""
    monkeypatch.setattr(painting, "NUM_COLORING_ROUNDS", 1)
    cloud = rooms.write_cloud(tmp_path / "scan.ply", 1, 20_000)
    queries = [rooms.query(1, index=k, width=256) for k in range(2)]
    paths = [str(tmp_path / COLOR.format(k)) for k in range(2)]
    for path, query in zip(paths, queries, strict=True):
        write(Path(path), encoded(query.rgb, ".png"))
    words = ["--cloud", cloud, "--cache", str(tmp_path / "maps"), "--gravity", "known", "--pano", *paths]
    scan = piccolo.open_scan(cloud, cache=tmp_path / "maps")

    def run(name, *more):
        out = tmp_path / f"{name}.jsonl"
        main([*words, *more, "--quiet", "--out", str(out)])
        return _lines(out)

    poses = [query.pose for query in queries]
    taken = [result(path, pose) for path, pose in zip(paths, poses, strict=True)]
    export(taken, "nerfstudio", tmp_path / "poses.json", Options(size=(256, 128)))
    by_file = run("bundle", "--relative", str(tmp_path / "poses.json"))
    relative = read_relative_poses(tmp_path / "poses.json", [Path(path) for path in paths])
    bundled = [_untimed(r.to_json()) for r in scan.localize_bundle(paths, relative, gravity="known")]
    for line in by_file:
        assert len(line["settings"].pop("relative_sha256")) == 64
    assert by_file == bundled
    walked = [_untimed(r.to_json()) for r in scan.localize_walk(paths, [0.0, 1.0], gravity="known")]
    assert run("walk", "--walk", "--times", "names") == walked
    color = tmp_path / "colored.ply"
    found = scan.color(paths, tmp_path / "own.ply", gravity="known")
    assert run("color", "--color-scan", str(color)) == [_untimed(r.to_json()) for r in found.results]
    assert (tmp_path / "own.ply").read_bytes() == color.read_bytes()
    assert 0 < found.num_colored <= found.num_points
