"""The paper's method: its starts, poses, refusals."""

import dataclasses

import numpy as np
import pytest
import rooms
from golden_poses import check_golden_poses
from refusals import assert_input_error
from rooms import as_panorama, errors, query, room

from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Pose, uniform_rotations
from piccolo.judge.result_parts import Evidence
from piccolo.localization.paper import (
    PROBE_WIDTH,
    PaperSettings,
    color_histogram,
    free_grid,
    histogram_similarity,
    localize_by_paper,
    paper_confidence,
    prepare_by_paper,
)
from piccolo.photo.panorama.panorama import shrink
from piccolo.scan_map.camera_positions import MIN_CLEARANCE
from piccolo.system.jobs.threads import Stopwatch, Workers
from piccolo.views.zbuffer import is_free_space

TIER = "scene"

QUICK = dataclasses.replace(PaperSettings(), num_translations=30, max_points=30_000, num_iterations=60)


def _localize(seed, variant, settings, num_threads=2):
    cloud = room(seed)[1]
    watch = Stopwatch()
    panorama = as_panorama(query(seed, variant).rgb)
    return localize_by_paper(
        prepare_by_paper(cloud.pack(), settings), panorama, settings, Workers(num_threads), watch
    ), watch


@pytest.mark.parametrize(("seed", "variant"), [(1, "clean"), (4, "clean"), (1, "photo"), (4, "change")])
def test_upright_camera_is_found(seed, variant):
    found, watch = _localize(seed, variant, QUICK)
    rooms.assert_near(found.best_pose, query(seed, variant).pose, 0.05, 1.0)
    assert found.confidence > 0.5
    # furniture that has moved costs a quarter of the confidence, and the line is at 0.9
    assert (found.status == "localized") == (variant != "change")
    assert set(watch.seconds) == {"search", "refine"}


def test_tilted_camera_is_found_with_unknown_gravity_and_by_lbfgs():
    found, _ = _localize(5, "tilt", dataclasses.replace(QUICK, gravity="unknown", num_rotations=96))
    distance, angle_deg = errors(found.pose, query(5, "tilt").pose)
    assert distance < 0.05
    assert angle_deg < 1.0
    found, _ = _localize(1, "clean", dataclasses.replace(QUICK, solver="lbfgs"))
    distance, _ = errors(found.pose, query(1).pose)
    assert distance < 0.02


def test_same_bits_for_any_number_of_threads():
    one, two = (_localize(1, "clean", QUICK, n)[0] for n in (1, 2))
    assert one.pose.key == two.pose.key
    assert (one.loss, one.evidence, one.confidence) == (two.loss, two.evidence, two.confidence)


@pytest.mark.parametrize("name", ["room 1", "black", "noise"])
def test_panorama_from_elsewhere_is_not_localized(name):
    noise = np.random.default_rng(0).integers(0, 256, (256, 512, 3), dtype=np.uint8)
    rgb = {"room 1": query(1).rgb, "black": np.zeros_like(noise), "noise": noise}[name]
    found = localize_by_paper(
        prepare_by_paper(room(2)[1].pack(), QUICK), as_panorama(rgb), QUICK, Workers(2), Stopwatch()
    )
    assert found.status == "not_localized"


def test_panorama_of_which_nothing_counts_has_no_pose():
    panorama = as_panorama(query(1).rgb)
    masked = dataclasses.replace(panorama, is_valid=np.zeros_like(panorama.is_valid))
    found = localize_by_paper(
        prepare_by_paper(room(1)[1].pack(), QUICK), masked, QUICK, Workers(1), Stopwatch()
    )
    assert found.status == "not_localized"
    assert found.pose is None


def test_golden_poses():
    """Where the descent has ended: before, processors differ by a centimetre."""
    settled = dataclasses.replace(QUICK, num_iterations=300)

    def arrays(seed):
        return [prepare_by_paper(room(seed)[1].pack(), QUICK).positions]

    check_golden_poses("paper.json", arrays, lambda *taken: _localize(*taken, settled)[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_translations": 0}, "num_translations: found 0"),
        ({"num_rotations": -1}, "num_rotations: found -1"),
        ({"grid_margin": 0.5}, "grid_margin: found 0.5"),
        ({"histogram_bins": 1}, "histogram_bins: found 1"),
        ({"patience": 0}, "patience: found 0"),
    ],
)
def test_settings_that_mean_nothing_are_refused_and_rotations_default_to_the_papers(change, message):
    assert PaperSettings().effective_num_rotations == 8
    assert PaperSettings(gravity="unknown").to_json()["num_rotations"] == 32
    assert_input_error(message, lambda: dataclasses.replace(PaperSettings(), **change))


def test_the_preset_paper_goes_by_margin_and_agreement():
    """From the weights as they were fitted, by a pocket calculator."""
    evidence = Evidence(0.15, 0.15, 0.4, 0.85, 0.93)
    assert paper_confidence(evidence) == pytest.approx(0.1759, abs=0.001)
    clearer = Evidence(0.15, 0.25, 0.5, 0.85, 0.93)
    assert paper_confidence(clearer) > paper_confidence(evidence)


def _hollow_box(seed=0, count=40_000):
    """Points on the walls of a 6 x 4 x 3 m box around (10, 20, 1.5), and of a pillar in it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    walls = points * [6, 4, 3]
    pillar = points[: count // 4] * [1, 1, 3]
    return pack_points(
        (np.concatenate([walls, pillar]) + np.array([10, 20, 1.5])).astype(np.float32),
        np.full((count + count // 4, 3), 128, dtype=np.uint8),
    )


def _is_free(points, center):
    return is_free_space(points, center, PROBE_WIDTH, MIN_CLEARANCE)


def test_free_is_inside_and_clear_of_surfaces():
    points = _hollow_box()
    assert _is_free(points, np.array([8.5, 20.0, 1.5]))
    assert not _is_free(points, np.array([8.5, 21.9, 1.5]))  # 0.1 m from a wall
    assert not _is_free(points, np.array([20.0, 20.0, 1.5]))  # outside
    rng = np.random.default_rng(0)
    solid = pack_points(rng.uniform(0, 1, (20_000, 3)).astype(np.float32), np.zeros((20_000, 3), np.uint8))
    assert len(free_grid(solid, 5, 0.0)) == 0


@pytest.mark.parametrize("num_translations", [1, 5, 50])
def test_free_grid_gives_the_number_asked_for_all_free(num_translations):
    points = _hollow_box()
    grid = free_grid(points, num_translations, margin=0.0)
    assert len(grid) == num_translations
    assert all(_is_free(points, position) for position in grid)
    assert len(np.unique(grid, axis=0)) == num_translations


@pytest.mark.parametrize("count", [32, 500])
def test_rotations_cover_so3_evenly(count):
    rotations = uniform_rotations(count)
    products = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (count, 1, 1)), atol=1e-12)
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    np.fill_diagonal(traces, -1.0)
    nearest = np.arccos(np.clip((traces.max(axis=1) - 1.0) / 2.0, -1.0, 1.0))
    # the volume of SO(3) shared evenly gives each rotation a ball of this radius
    ideal = 2.0 * (6.0 * np.pi / (8.0 * count)) ** (1.0 / 3.0)
    assert nearest.min() > 0.5 * ideal
    assert nearest.max() < 2.0 * ideal


def test_histogram_counts_solid_angle():
    rgb = np.zeros((64, 128, 3), dtype=np.float32)
    rgb[:16] = 1.0  # a quarter of the rows, about the zenith: (1 - cos 45 deg) / 2 of the sphere
    histogram = color_histogram(rgb, np.ones((64, 128), dtype=bool), 4)
    assert histogram.sum() == pytest.approx(1.0)
    assert histogram[-1] == pytest.approx((1 - np.cos(np.pi / 4)) / 2, rel=1e-6)
    histogram = color_histogram(np.ones((16, 32, 3), np.float32), np.zeros((16, 32), bool), 8)
    assert histogram.sum() == 0.0


def test_histograms_agree_best_at_the_true_place():
    points, panorama, true_pose = rooms.scene(1)
    small = shrink(panorama, 128)
    elsewhere = Pose(true_pose.R_cam_from_world, -true_pose.center_world)
    here, there = (histogram_similarity(points, small, pose, 8) for pose in (true_pose, elsewhere))
    assert here > max(0.75, there)
