"""Places alike to a degree: equal units where nothing is changed, and as many unlike things as asked for."""

import itertools

import numpy as np
import pytest
from measuring import confidence
from measuring.places import ALIKE_KINDS, CHANGED, make_alike, thing_seeds

from piccolo.jobs.threads import Workers
from piccolo.scenes.synthetic.world import World, make_query


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


def test_the_fraction_of_changed_things_is_the_one_asked_for():
    for changed in (0.0, 0.2, 1.0):
        seeds = [s for unit in range(100) for s in thing_seeds(5, unit, 10, changed)]
        own = np.mean([s[-1] > 0 for s in seeds])
        assert abs(own - changed) < 0.05
    assert list(thing_seeds(5, 1, 3, 0.0)) == list(thing_seeds(5, 2, 3, 0.0))


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
