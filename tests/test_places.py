"""Made-up places and damaged photos of the measurements: as alike, as hidden and as lit as asked for."""

import itertools

import numpy as np
import pytest
import rooms

from piccolo.geometry.sphere import pixel_rays, solid_angles
from piccolo.system.jobs.threads import Workers
from research.measuring import confidence
from research.measuring.confidence import remove_texture
from research.synthetic.layout import PLAIN
from research.synthetic.places import ALIKE_KINDS, CHANGED, make_alike
from research.synthetic.world import (
    MOST_RADIUS,
    World,
    light_unevenly,
    make_query,
    mask_outside_field,
    occlude,
)

WIDTH = 256


@pytest.mark.parametrize("fraction", [0.0, 0.2, 0.6])
def test_occluders_hide_what_is_asked_and_hardly_more(fraction):
    rgb, other = np.full((WIDTH // 2, WIDTH, 3), 10, np.uint8), np.full((WIDTH // 2, WIDTH, 3), 200, np.uint8)
    shown = occlude(rgb, other, fraction, np.random.default_rng(3))
    hidden = ((shown == 200).all(axis=2) * solid_angles(WIDTH)[:, None]).sum() / (4 * np.pi)
    assert fraction <= hidden < fraction + 0.5 * (1 - np.cos(MOST_RADIUS)) + 0.01
    assert ((shown == 10) | (shown == 200)).all()
    again = occlude(rgb, other, fraction, np.random.default_rng(3))
    np.testing.assert_array_equal(shown, again)


@pytest.mark.parametrize(("fov_deg", "yaw"), [(65.0, 0.4), (90.0, -2.0), (120.0, 3.0)])
def test_a_field_is_that_of_a_level_pinhole(fov_deg, yaw):
    is_outside = mask_outside_field(WIDTH, fov_deg, yaw)
    focal = 0.5 / np.tan(np.radians(fov_deg) / 2)  # of an image 1 wide and 0.75 high
    rays = pixel_rays(WIDTH).reshape(-1, 3)
    azimuth = np.arctan2(rays[:, 1], rays[:, 0]) - yaw
    right = -np.tan(azimuth)
    elevation = np.arcsin(rays[:, 2])
    down = -np.tan(elevation) / np.cos(azimuth)
    is_inside = (np.cos(azimuth) > 0) & (np.abs(focal * right) <= 0.5) & (np.abs(focal * down) <= 0.375)
    assert (is_outside.ravel() == ~is_inside).mean() > 0.9999
    u = (0.5 - yaw / (2 * np.pi)) % 1.0 * WIDTH
    assert not is_outside[WIDTH // 4, int(u)]


def test_light_is_uneven_by_the_stops_asked():
    rgb = np.full((WIDTH // 2, WIDTH, 3), 100, np.uint8)
    lit = light_unevenly(rgb, 1.0, np.random.default_rng(5))
    assert (lit == lit[..., :1]).all()  # light has no colour
    stops = 2.2 * np.log2(np.maximum(lit[..., 0], 1) / 100)
    assert abs(stops.mean()) < 0.2
    assert 0.3 < stops.std() < 0.7
    assert np.abs(np.diff(lit[..., 0].astype(int), axis=1)).max() < 12


def test_rooms_without_texture_keep_their_shape():
    world = rooms.room(1)[0]
    bare = remove_texture(world)
    assert (bare.rooms[0].materials[:, 0] == PLAIN).all()
    assert (world.rooms[0].materials[:, 0] != PLAIN).any()
    np.testing.assert_array_equal(bare.rooms[0].boxes, world.rooms[0].boxes)


def test_rooms_of_a_hotel_are_copies_until_things_are_changed():
    size, *same = (room.boxes - np.array([*room.corner, 0, 0, 0, 0]) for room in make_alike("hotel", 3, 0.0))
    assert len(same) == 4
    for boxes in same:
        np.testing.assert_allclose(boxes, size, atol=1e-9)
    changed = make_alike("hotel", 3, 0.5)
    assert any(len(a.boxes) != len(b.boxes) or (a.materials != b.materials).any()
               for a, b in itertools.pairwise(changed))  # fmt: skip


@pytest.mark.parametrize("kind", ["doors", "cubicles", "racks"])
def test_units_repeat_in_material_and_size(kind):
    """Things of one unit come as often as there are units."""
    (room,) = make_alike(kind, 2, 0.0)
    _, counts = np.unique(room.materials, axis=0, return_counts=True)
    units = {"doors": 8, "cubicles": 10, "racks": 24}[kind]
    assert (counts >= units).sum() >= 4
    (other,) = make_alike(kind, 2, 0.5)
    _, changed = np.unique(other.materials, axis=0, return_counts=True)
    assert len(changed) > len(counts)


@pytest.mark.parametrize("kind", ALIKE_KINDS)
def test_photos_are_taken_in_free_space(kind):
    world = World(1, make_alike(kind, 1, 0.1))
    taken = make_query(world, 0, "clean", 128, Workers(2))
    assert min(room.clearance(taken.pose.center_world) for room in world.rooms) > 0.0
    assert taken.rgb.std() > 5.0


def test_trials_of_alike_places(monkeypatch):
    monkeypatch.setattr(confidence, "WIDTH", 128)
    monkeypatch.setattr(confidence, "POINTS_PER_ROOM", 2000)
    found = list(confidence.alike_trials(1, ["doors"], Workers(2)))
    assert len(found) == len(CHANGED)
    for (_, trials), changed in zip(found, CHANGED, strict=True):
        cases = [trial.case for trial in trials]
        name = f"doors, {changed:.0%} changed"
        assert cases == [*[name] * 4, f"{name}, hidden 30%", "doors, elsewhere"]
        assert [trial.true_pose is None for trial in trials] == [False] * 5 + [True]
