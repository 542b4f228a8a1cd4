"""Places outdoors: the same from a seed, scanned with the errors of each scanner, and photographed."""

import itertools

import numpy as np
import pytest

from piccolo.evidence.focal_length import NOT_CALIBRATED
from piccolo.photo.camera.model import camera_of_fov
from piccolo.photo.panorama.cameras import OF_PIXELS
from piccolo.system.jobs.threads import Workers
from research.measuring import outdoor_trials as trials
from research.synthetic import outdoor_photos, outdoor_scans as scans, world as worlds
from research.synthetic.layout import PLAIN, RoomBuilder
from research.synthetic.outdoor_photos import draw_lens, take_panorama, take_photo
from research.synthetic.outdoors import PLACE_KINDS, SKY, SUN, make_place
from research.synthetic.raycast import cast_rays

WORKERS = Workers(2)
pytestmark = pytest.mark.research
SIZE = (256, 192)  # [px] of photos


@pytest.fixture(autouse=True)
def _small_photos(monkeypatch):
    monkeypatch.setattr(worlds, "PHOTO_SIZE", SIZE)


@pytest.mark.parametrize("kind", PLACE_KINDS)
def test_a_seed_makes_one_open_place_and_another_makes_another(kind):
    place = make_place(kind, 3)
    again = make_place(kind, 3)
    other = make_place(kind, 4)
    np.testing.assert_array_equal(place.room.boxes, again.room.boxes)
    np.testing.assert_array_equal(place.room.materials, again.room.materials)
    assert place.room.boxes.shape != other.room.boxes.shape or (place.room.boxes != other.room.boxes).any()
    above = scans.draw_position(place, np.random.default_rng(1), (1.6, 1.6))
    ranges, rgb, _ = cast_rays(place.room, above, np.array([[0.0, 0.0, 1.0]]), Workers(), "")
    np.testing.assert_array_equal([*ranges, *rgb[0]], [np.inf, *SKY])
    assert place.room.clearance(above) >= scans.CLEARANCE


def test_a_sun_lights_all_of_a_wall_alike_and_a_lamp_does_not():
    b = RoomBuilder(np.random.default_rng(0), np.zeros(3))
    one_color = np.array([PLAIN, 0.3, *(0.4, 0.5, 0.6) * 2, 1.0])
    b.put([0.0, 5.0, 0.0], [40.0, 1.0, 40.0], one_color)
    room = b.room(np.ones(3), SUN)
    rays = np.array([[0.02, 1.0, 0.01], [1.3, 1.0, 0.01]])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    near, far = cast_rays(room._replace(sky=SKY), np.full(3, 0.1), rays, Workers(), "")[1]
    np.testing.assert_allclose(near, far, rtol=1e-3)
    near, far = cast_rays(room._replace(light=np.zeros(3)), np.full(3, 0.1), rays, Workers(), "")[1]
    assert (near > 1.1 * far).all()


def _errors(kind, scanner, monkeypatch):
    """Return the ranges (N,) [m] of a scan's first shot, and their errors."""
    for name, count in (("NUM_STATIONS", 1), ("STATION_WIDTH", 256), ("NUM_PAIRS", 2), ("BEAM_WIDTH", 90)):
        monkeypatch.setattr(scans, name, count)
    monkeypatch.setattr(scans, "SWEEP_ERROR", 0.0)
    shots = []
    measure = scans.measure
    monkeypatch.setattr(scans, "measure", lambda place, *rest: shots.append(rest[0]) or measure(place, *rest))
    place = make_place(kind, 5)
    points, colors = scans.scan_place(place, scanner, WORKERS)
    assert points.shape == colors.shape
    first = shots[0]
    ranges = cast_rays(place.room, first.position, first.rays, WORKERS, "")[0]
    ranges = ranges[ranges < scans.MOST_RANGE]
    offsets = points[: len(ranges)] - first.position
    return ranges, np.linalg.norm(offsets, axis=1) - ranges


@pytest.mark.parametrize(
    ("kind", "scanner", "noise"),
    [("yard", "station", scans.STATION_NOISE), ("street", "car", scans.LIDAR_NOISE)],
)
def test_ranges_of_scanners_have_the_same_errors_at_all_distances(kind, scanner, noise, monkeypatch):
    ranges, errors = _errors(kind, scanner, monkeypatch)
    for part in (ranges < np.median(ranges), ranges > np.median(ranges)):
        assert errors[part].std() == pytest.approx(noise, rel=0.1)


def test_errors_of_stereo_grow_with_the_square_of_the_range_and_are_alike_nearby(monkeypatch):
    ranges, errors = _errors("street", "stereo", monkeypatch)
    is_far = ranges > np.median(ranges)
    relative = errors / ranges**2
    assert relative[is_far].std() == pytest.approx(relative[~is_far].std(), rel=0.2)
    assert relative.std() == pytest.approx(scans.STEREO_ERROR, rel=0.2)
    assert 0.3 < np.corrcoef(relative[:-1], relative[1:])[0, 1] < 0.7


def test_lenses_are_as_far_from_ideal_as_is_allowed_for():
    ideal = camera_of_fov("pinhole", 70.0, 1024, 768)
    rng = np.random.default_rng(0)
    drawn = [draw_lens(ideal, rng) for _ in range(400)]
    focal, fy, x, y, radial = np.array([lens.params[:5] for lens in drawn]).T
    np.testing.assert_array_equal(focal, ideal.focal[0])
    off = np.log(fy / focal), (x - 512.0) / focal, (y - 384.0) / fy, radial
    np.testing.assert_allclose(np.std(off, axis=1), NOT_CALIBRATED, rtol=0.15)
    np.testing.assert_allclose(np.mean(off, axis=1), 0.0, atol=0.001)


def test_a_photo_shows_what_rays_from_its_pose_hit(monkeypatch):
    """A photo of the sky's edge: as bright as the sky where the rays end there."""
    place = make_place("street", 2)
    monkeypatch.setattr(outdoor_photos, "draw_lens", lambda ideal, _: ideal)
    photo = take_photo(place, 0, WORKERS)
    width, height = SIZE
    assert photo.rgb.shape == (height, width, 3)
    camera = camera_of_fov(
        "pinhole", 2.0 * np.degrees(np.arctan(0.5 * width / photo.focal_px)), width, height
    )
    pixels = np.stack(np.meshgrid(np.arange(2, width, 4) + 0.5, np.arange(2, height, 4) + 0.5), axis=-1)
    rays, _ = camera.rays(pixels)
    rays = rays.reshape(-1, 3) @ photo.pose.R_cam_from_world
    ranges, rgb, _ = cast_rays(place.room, photo.pose.center_world, rays, WORKERS, "")
    shown = photo.rgb[2::4, 2::4].reshape(-1, 3)
    assert np.isinf(ranges).any()
    assert np.corrcoef(rgb.mean(axis=1), shown.mean(axis=1))[0, 1] > 0.9
    assert photo.pose.R_cam_from_world[2, 2] > np.cos(np.radians(20.0))  # held about level


def test_panoramas_are_upright_and_another_number_another_one():
    place = make_place("yard", 2)
    one, other = (take_panorama(place, index, 128, WORKERS) for index in (0, 1))
    assert one.pose.R_cam_from_world[2, 2] == 1.0
    assert one.pose.distance(other.pose) > 0.0
    ranges, *_ = cast_rays(place.room, one.pose.center_world, one.pose.R_cam_from_world[:1], Workers(), "")
    assert ranges[0] > scans.CLEARANCE


def test_trials_have_photos_of_the_place_and_of_another(monkeypatch):
    monkeypatch.setattr(trials, "scan_place", lambda place, scanner, _: (place.kind, scanner))
    photo = take_photo(make_place("front", 0), 0, WORKERS)
    monkeypatch.setattr(trials, "take_photo", lambda place, *_: photo)
    monkeypatch.setattr(trials, "take_panorama", lambda place, *_: photo)
    made = list(trials.outdoor_trials(0, PLACE_KINDS, WORKERS))
    assert [scan for scan, _ in made] == [(k, s) for k in PLACE_KINDS for s in scans.SCANNERS[k]]
    for scan, own in made:
        cases = [f"{' by '.join(scan)}, {what}" for what in ("photo", "panorama", "elsewhere")]
        assert list(dict.fromkeys(trial.case for trial in own)) == cases
        assert all((trial.true_pose is None) == trial.case.endswith("elsewhere") for trial in own)
    off = np.log([t.focal_px / photo.focal_px for t in made[0][1] if t.case.endswith(", photo")])
    assert 0.1 * OF_PIXELS < np.abs(off).max() < 4.0 * OF_PIXELS
    counts = trials.NUM_PHOTOS + trials.NUM_PANORAMAS + trials.NUM_ELSEWHERE
    assert {len(own) for _, own in made} == {counts}
    assert len(list(itertools.chain(*(own for _, own in made)))) == counts * len(made)
