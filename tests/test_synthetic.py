"""Made rooms, offices and walks, their photos, and tools/make_room.py."""

import functools
import itertools
import json
import sys

import av
import cv2
import naive
import numpy as np
import pytest
import rooms
from scans import read_cloud

from piccolo.geometry.pose import (
    OPTICAL_FROM_CAM,
    Pose,
    angle_between,
    rotation_from_quaternion_wxyz,
    yaw_rotation,
)
from piccolo.geometry.sphere import pixel_rays
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Workers
from research.scene import read_scene
from research.synthetic import make_room as tool
from research.synthetic.layout import make_room
from research.synthetic.office import make_office
from research.synthetic.raycast import cast_rays, hit_boxes
from research.synthetic.walk_frames import BAD_KINDS, WalkOptions, frames_of
from research.synthetic.walking import HEIGHT, Walker
from research.synthetic.world import (
    RANGE_NOISE,
    VARIANTS,
    free_position,
    make_query,
    make_world,
    photograph,
    scan_world,
)

pytestmark = pytest.mark.research

SMALL = np.array([3.0, 3.0, 2.4])


def test_clearance_is_the_distance_to_the_nearest_surface():
    """Negative inside a box, where rays see no surface: a camera was put into a crate because of that."""
    this = make_room(5, SMALL, np.zeros(3))
    rays = pixel_rays(512).reshape(-1, 3)
    rng = np.random.default_rng(1)
    for _ in range(5):
        position = free_position(this, rng, (1.0, 1.9))
        nearest = cast_rays(this, position, rays, Workers(), "")[0].min()
        assert nearest - 0.02 < this.clearance(position) <= nearest + 1e-9
    assert all(this.clearance(box[:3]) < 0 for box in this.boxes)


def test_room_without_a_free_place_and_an_unknown_variant_are_refused():
    this = make_room(5, SMALL, np.zeros(3))
    full = this._replace(boxes=np.array([[*(SMALL / 2), *(SMALL / 2), 0.0]]))
    with pytest.raises(InputError, match=r"size`: .* no free position 0\.35 m from everything"):
        free_position(full, np.random.default_rng(0), (1.0, 1.9))
    with pytest.raises(InputError, match="variant: found 'odd', wanted one of"):
        make_query(make_world(0, SMALL), 0, "odd", 128, Workers())


def test_scan_lies_on_surfaces_inside_the_walls_and_keeps_rooms_apart():
    world = make_world(2, SMALL, num_rooms=2)
    points, *_ = scan_world(world, 4000, Workers(2))
    distances = [min(abs(room.clearance(point)) for room in world.rooms) for point in points.astype(float)]
    assert max(distances) < 5 * RANGE_NOISE
    walls = [(r.corner - 0.03, r.corner + r.size + 0.03) for r in world.rooms]
    inside = [((points > low) & (points < high)).all(axis=1) for low, high in walls]
    assert (inside[0] | inside[1]).all()
    assert inside[0].sum() == inside[1].sum() == 2000


def test_same_seed_same_bits_at_any_number_of_threads():
    a, b = (scan_world(make_world(1, SMALL), 5000, Workers(n)) for n in (1, 2))
    np.testing.assert_array_equal(a[0], b[0])
    np.testing.assert_array_equal(a[1], b[1])
    world = make_world(1, SMALL)
    for variant in VARIANTS:
        a, b = (make_query(world, 0, variant, 128, Workers(n)) for n in (1, 2))
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.pose.center_world, b.pose.center_world)


@pytest.mark.parametrize("variant", ["clean", "tilt"])
def test_panorama_shows_the_scans_colours_where_the_convention_puts_them(variant):
    """A wrong frame, a mirrored axis or a seam half a turn off would make the colours disagree."""
    cloud = rooms.room(1)[1]
    taken = rooms.query(1, variant)
    shown = taken.pose, taken.rgb, 180, 0.05
    difference = naive.color_differences(rooms.points_world(1), cloud.colors, *shown)
    assert len(difference) > 0.3 * len(cloud.points)
    assert np.median(difference) < 4.0


def test_change_alters_a_part_of_the_sphere():
    rays = pixel_rays(128).reshape(-1, 3)
    before, after = (make_room(4 * 64, SMALL, np.zeros(3), changed) for changed in (0, 1))
    a, b = (cast_rays(r, SMALL / 2, rays, Workers(), "")[1] for r in (before, after))
    assert 0.05 < (np.abs(a - b).max(axis=1) > 0.02).mean() < 0.7


def test_command_line_writes_a_world_that_reads_back(tmp_path, capsys):
    folder = tmp_path / "a room"
    options = "--points 3000 --width 128 --panoramas 2 --size 3 3 2.4 --variants clean photo clean --quiet"
    assert tool.main(["--out", str(folder), *options.split()]) == 0
    out, err = capsys.readouterr()
    assert (json.loads(out)["queries"], err) == (4, "")
    assert len(read_cloud(folder / "cloud.ply").points) == 3000
    images = [folder / "images" / f"{v}_{k}.jpg" for v in ("clean", "photo") for k in (0, 1)]
    assert [query.image for query in read_scene(folder).queries] == images
    assert all(image.is_file() for image in images)


SIZE = np.array([4.0, 3.2, 2.5])
WORKERS = Workers(2)


@functools.lru_cache
def office():
    return make_office(5, SIZE, num_rooms=6, num_storeys=2, twins=0.4)


@functools.lru_cache
def walk():
    return Walker(office()).walk(60.0, np.random.default_rng(0))


def frames(**options):
    return list(frames_of(office(), walk(), WalkOptions(width=128, **options), 0, WORKERS))


def is_in_room(number, feet):
    room = office().world.rooms[number]
    return ((feet >= room.corner - 0.01) & (feet <= room.corner + room.size)).all(axis=-1)


def test_rays_meet_what_is_nearest_among_hundreds_of_boxes():
    """Boxes aside and behind others are left out; alike for rays side by side and for rays all around."""
    room = office().world.rooms[0]
    rng = np.random.default_rng(0)
    around = rng.normal(size=(500, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    for cell in (0, 3, 7, 10):
        origin = office().world.rooms[cell].corner + np.array([1.0, 1.1, 1.9])
        for rays in (around, pixel_rays(128)[20:40, 30:50].reshape(-1, 3)):
            ranges, rgb, labels = cast_rays(room, origin, rays, WORKERS, "")
            np.testing.assert_allclose(ranges, naive.nearest_box(origin, rays, room.boxes), rtol=1e-9)
            assert np.isfinite(ranges).all(), "the building is not closed"
            assert (labels > 0).all()
            assert ((rgb >= 0) & (rgb <= 1)).all()
            assert (rgb.max(axis=1) > 0.02).mean() > 0.99


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("offset", [0.0, 0.5, -0.5, 0.499, 0.501, 3.0])
def test_rays_with_zero_components_meet_a_box_if_they_start_level_with_it(axis, offset):
    """One that runs along a face may meet it or not; see NO_ZERO."""
    rays = np.array([np.eye(3)[axis], -np.eye(3)[axis]])
    for beside in {0, 1, 2} - {axis}:
        origin = np.zeros(3)
        origin[axis] = -4.0
        origin[beside] = offset
        box = np.array([[0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.0]])
        ranges = np.empty(2)
        hits = np.empty(2, np.int64)
        hit_boxes(origin, rays, box, ranges, hits)
        assert ranges[1] == np.inf
        assert hits[1] == -1
        if abs(offset) != 0.5:
            is_hit = abs(offset) < 0.5
            assert ranges[0] == (pytest.approx(3.5) if is_hit else np.inf)
            assert hits[0] == (axis if is_hit else -1)


def test_copies_are_exact_and_others_are_not():
    copies = office().copies
    assert (copies != np.arange(6)).sum() == 2
    assert (copies[copies] == copies).all()
    views = []
    for number in range(6):
        cell = office().world.rooms[number]
        is_south = cell.corner[1] < SIZE[1]
        rays = pixel_rays(64).reshape(-1, 3) @ yaw_rotation(np.pi if is_south else 0.0)
        views.append(cast_rays(cell, cell.corner + cell.size / 2 * [1.0, 1.0, 1.3], rays, WORKERS, ""))
    for number, copy in enumerate(copies):
        is_same = np.abs(views[number][0] - views[copy][0]) < 1e-6
        is_same &= np.abs(views[number][1] - views[copy][1]).max(axis=1) < 1e-6
        assert is_same.mean() > 0.9, "only what shows through the door may differ"
        others = [k for k in range(6) if copies[k] != copy]
        assert all(np.abs(views[number][1] - views[k][1]).mean() > 0.05 for k in others)


@pytest.mark.parametrize(("num_rooms", "num_storeys"), [(1, 1), (3, 3), (17, 1), (40, 2)])
def test_a_person_can_walk_into_every_room(num_rooms, num_storeys):
    made = make_office(8, SIZE, num_rooms, num_storeys, 0.0)
    assert (made.copies == np.arange(num_rooms)).all()
    assert len(made.levels) == num_storeys
    cells = made.world.rooms[:num_rooms]
    assert len({tuple(cell.corner) for cell in cells}) == num_rooms
    walker = Walker(made)
    cells_of_room = walker.floors.cells_of_room
    assert all(np.isfinite(walker.everywhere.costs[cells_of_room(k)]).any() for k in range(num_rooms))


def test_walk_goes_through_doors_and_over_stairs_and_never_through_things():
    feet = walk().feet[::10]
    length = np.linalg.norm(np.diff(walk().feet[:, :2], axis=0), axis=1).sum()
    assert 55.0 < length < 62.0
    assert is_in_room(5, feet[0])
    assert is_in_room(0, feet).any()
    assert feet[:, 2].min() == 0.0
    assert feet[:, 2].max() == pytest.approx(office().levels[1])
    room = office().world.rooms[0]
    centers = [walk().pose(time).center_world for time in np.arange(0.0, walk().duration, 0.25)]
    assert min(room.clearance(center) for center in centers) > 0.2
    for foot, center in zip(walk().feet[::50], centers[::4], strict=False):
        below = cast_rays(room, center, np.array([[0.001, 0.002, -1.0]]), WORKERS, "")[0][0]
        assert abs(below - HEIGHT) < 0.35, "stairs are walked on, not through"
        assert abs(center[2] - foot[2] - HEIGHT) < 0.03


def test_walk_has_a_persons_speed_and_looks_where_it_goes():
    times = np.arange(0.0, walk().duration, 0.1)
    poses = [walk().pose(time) for time in times]
    centers = np.array([pose.center_world for pose in poses])
    steps = np.diff(centers[:, :2], axis=0)
    speed = np.linalg.norm(steps, axis=1) / 0.1
    assert 0.5 < speed.mean() < speed.max() < 1.5
    assert (speed < 0.05).mean() > 0.02, "pauses"
    turns = [angle_between(a.R_cam_from_world, b.R_cam_from_world) for a, b in itertools.pairwise(poses)]
    assert np.degrees(max(turns)) / 0.1 < 200.0
    ahead = np.array([pose.R_cam_from_world[0, :2] for pose in poses[:-1]])
    is_quick = speed > 0.8
    along = (ahead * steps).sum(axis=1)[is_quick] / (0.1 * speed[is_quick])
    assert np.median(along) > 0.95
    level = np.array([pose.R_cam_from_world[2, 2] for pose in poses])
    tilts = np.degrees(np.arccos(level))
    assert 0.5 < tilts.mean() < tilts.max() < 8.0


def test_frames_show_the_scan_at_their_poses():
    points, colors, _ = scan_world(office().world, 90_000, WORKERS)
    taken = frames(rate=0.1)
    assert [frame.time for frame in taken] == pytest.approx(np.arange(len(taken)) * 10.0)
    for frame in taken[1:4]:
        is_near = np.linalg.norm(points - frame.pose.center_world, axis=1) < 3.0
        near = points[is_near], colors[is_near]
        difference = naive.color_differences(*near, frame.pose, frame.rgb, 64, 0.03)
        assert len(difference) > 300
        assert np.median(difference) < 6.0


def test_frames_are_the_same_at_any_number_of_threads_and_people_hide_a_part():
    options = WalkOptions(0.1, "photo", 3, True, 0.3, 128)
    one, two = (list(frames_of(office(), walk(), options, 0, Workers(n))) for n in (1, 2))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.pose.center_world, b.pose.center_world)
        assert a.kind == b.kind
    alone, among = frames(rate=0.1), frames(rate=0.1, num_people=6)
    hidden = [(a.rgb != b.rgb).any(axis=2).mean() for a, b in zip(alone, among, strict=True)]
    assert 0.01 < max(hidden) < 0.5


def test_blur_is_the_mean_over_the_shutter():
    """Turning on the spot blurs across: the upright edges of a picture lose, the level ones stay."""
    room = office().world.rooms[0]
    center = room.corner + SIZE * [0.3, 0.4, 0.62]
    poses = [Pose(yaw_rotation(angle), center) for angle in np.radians(np.linspace(-6.0, 6.0, 8))]
    sharp, blurred = (photograph(room, poses[3], 256, WORKERS, some).astype(float) for some in ([], poses))
    upright, level = (
        [np.abs(np.diff(rgb[48:80], axis=axis)).mean() for rgb in (sharp, blurred)] for axis in (1, 0)
    )
    assert upright[1] < 0.7 * upright[0]
    assert level[1] > 0.6 * level[0]
    assert abs(sharp.mean() - blurred.mean()) < 2.0


def test_bad_frames_are_black_mirrored_or_of_elsewhere():
    good, some = frames(rate=0.2), frames(rate=0.2, bad_fraction=0.5)
    kinds = [frame.kind for frame in some]
    assert sum(kind in BAD_KINDS for kind in kinds) == round(0.5 * len(kinds))
    assert {*kinds} == {"clean", *BAD_KINDS}
    for a, b in zip(good, some, strict=True):
        np.testing.assert_array_equal(a.pose.center_world, b.pose.center_world)
        if b.kind == "black":
            assert b.rgb.max() < 8
        elif b.kind == "elsewhere":
            assert np.abs(a.rgb.astype(float) - b.rgb).mean() > 10.0
        else:
            np.testing.assert_array_equal(a.rgb, b.rgb[:, ::-1] if b.kind == "mirrored" else b.rgb)


def test_photos_of_a_walk_have_one_light_and_their_own_noise():
    both = (frames(rate=0.2, variant=variant) for variant in ("clean", "photo"))
    clean, photos = (np.array([frame.rgb for frame in taken], float) for taken in both)
    both = zip(photos, clean, strict=True)
    colors = [photo.mean(axis=(0, 1)) / picture.mean(axis=(0, 1)) for photo, picture in both]
    assert np.ptp(colors, axis=0).max() < 0.1 * np.mean(colors)
    fine = np.diff(photos, axis=2) - np.diff(clean, axis=2)
    alike = np.corrcoef(fine.reshape(len(fine), -1))[np.triu_indices(len(fine), 1)]
    assert abs(alike).max() < 0.3


def written(folder, words):
    command = f"--rooms 2 --size 4 3 2.5 --points 9000 --width 128 --frame-rate 1 --quiet {words}"
    return tool.main(["--out", str(folder), *command.split()])


def test_command_line_writes_walks_that_read_back(tmp_path, capsys):
    folder = tmp_path / "walks"
    assert written(folder, "--walk 12 --walks 2 --bad-frames 0.3 --video --twins 0.5") == 0
    assert json.loads(capsys.readouterr().out)["queries"] == len(list((folder / "images").iterdir()))
    queries = read_scene(folder).queries
    assert {query.walk for query in queries} == {"clean_walk_0", "clean_walk_1"}
    first = [query for query in queries if query.walk == "clean_walk_0"]
    assert [query.time for query in first] == list(range(len(first)))
    assert {query.variant for query in first if query.is_answerable} == {"clean"}
    assert {query.variant for query in first if not query.is_answerable} <= set(BAD_KINDS)
    assert sum(not query.is_answerable for query in first) == round(0.3 * len(first))
    rows = np.loadtxt(folder / "clean_walk_0_poses.tum")
    assert len(rows) == len(first)
    for query, (time, *center, x, y, z, w) in zip(first, rows.tolist(), strict=True):
        assert (query.time, query.pose.center_world.tolist()) == (time, center)
        R_world_from_optical = rotation_from_quaternion_wxyz(np.array([w, x, y, z]))
        expected = (OPTICAL_FROM_CAM @ query.pose.R_cam_from_world).T
        np.testing.assert_allclose(R_world_from_optical, expected, atol=1e-9)
    with av.open(folder / "clean_walk_0.mp4") as video:
        shown = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert video.streams.video[0].average_rate == 1
    assert len(shown) == len(first)
    for query, rgb in zip(first, shown, strict=True):
        assert np.abs(cv2.imread(str(query.image))[..., ::-1].astype(float) - rgb).mean() < 6.0


def test_a_video_without_its_library_is_refused_before_anything_is_made(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    assert written(tmp_path / "r", "--walk 5 --video") == 3
    assert "--video: needs av" in (message := capsys.readouterr().err)
    assert "pip install 'piccolo-localize[video]'" in message
    assert not (tmp_path / "r").exists()


def test_a_building_without_a_walk_has_single_panoramas(tmp_path, capsys):
    assert written(tmp_path, "--storeys 2 --panoramas 2 --variants clean tilt --labels") == 0
    capsys.readouterr()
    queries = read_scene(tmp_path).queries
    assert [query.variant for query in queries] == ["clean", "clean", "tilt", "tilt"]
    assert all(query.walk is None and query.is_answerable and query.labels.is_file() for query in queries)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--points 10", "--points: found 10, wanted at least 1000 per room"),
        ("--width 127", "--width: found 127, wanted an even number of at least 128"),
        ("--size nan 3 2.4", "--size: found [nan, 3.0, 2.4], wanted 2.0 to 50.0 m in each direction"),
        ("--rooms 257", "--rooms: found 257, wanted 1 to 256"),
        ("--seed -1", "--seed: found -1, wanted at least 0"),
        ("--twins 0.5", "--twins: only with --storeys or --walk"),
        ("--storeys 2 --variants change", "--variants: found change, wanted others in a building"),
        ("--people 2", "--people: only with --walk"),
        ("--bad-frames 0.1", "--bad-frames: only with --walk"),
        ("--walk nan", "--walk: found nan, wanted up to 100000 m"),
        ("--walk 5 --labels", "--labels, --camera: not with --walk"),
        ("--walk 5 --variants tilt", "--variants: found tilt, wanted clean or photo in a walk"),
        ("--walk 5 --frame-rate 0", "--frame-rate: found 0.0, wanted 0.1 to 120 per second"),
        ("--walk 5 --bad-frames 2", "--bad-frames: found 2.0, wanted 0 to 1"),
        ("--walk 5 --people 21", "--people: found 21, wanted 0 to 20"),
        ("--walk 5 --twins 1", "--twins: found 1.0, wanted at least 0 and less than 1"),
        ("--storeys 5", "--storeys: found 5, wanted 1 to 4"),
        ("--storeys 3", "--rooms: found 2, wanted one per storey to 256"),
        ("--storeys 1 --size 2.5 4 3", "--size: found [2.5, 4.0, 3.0], wanted [2.6, 2.6, 2.3] to 50.0 m"),
        ("--storeys 2 --size 4 4 9", "--size: rooms of [4.0, 4.0, 9.0] m are too high for stairs"),
    ],
)
def test_command_line_refuses_in_one_line_before_anything_is_written(words, message, tmp_path, capsys):
    assert written(tmp_path / "r", words) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"make_room.py: {message}")
    assert not (tmp_path / "r").exists()
