import json

import naive
import numpy as np
import pytest
from rooms import query, room

from piccolo.cloud import read_cloud
from piccolo.errors import InputError
from piccolo.geometry.sphere import pixel_rays
from piccolo.jobs.threads import Workers
from piccolo.scene import read_scene
from research.synthetic import make_room as tool
from research.synthetic.layout import make_room
from research.synthetic.raycast import cast_rays
from research.synthetic.world import (
    RANGE_NOISE,
    VARIANTS,
    free_position,
    make_query,
    make_world,
    scan_world,
)

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
    cloud = room(1)[1]
    taken = query(1, variant)
    difference = naive.color_differences(
        cloud.points + cloud.origin_world, cloud.colors, taken.pose, taken.rgb, 180, 0.05
    )
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
