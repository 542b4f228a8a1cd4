import dataclasses

import numpy as np
import pytest
from golden_poses import check_golden_poses
from rooms import as_panorama, errors, query, room

from piccolo.confidence.localization import Evidence
from piccolo.errors import InputError
from piccolo.jobs.stopwatch import Stopwatch
from piccolo.jobs.threads import Workers
from piccolo.paper.localize import localize, paper_confidence, prepare
from piccolo.paper.settings import PaperSettings

QUICK = dataclasses.replace(PaperSettings(), num_translations=30, max_points=30_000, num_iterations=60)


def _localize(seed, variant, settings, num_threads=2):
    cloud = room(seed)[1]
    watch = Stopwatch()
    panorama = as_panorama(query(seed, variant).rgb)
    return localize(prepare(cloud, settings), panorama, settings, Workers(num_threads), watch), watch


@pytest.mark.parametrize(("seed", "variant"), [(1, "clean"), (4, "clean"), (1, "photo"), (4, "change")])
def test_upright_camera_is_found(seed, variant):
    found, watch = _localize(seed, variant, QUICK)
    distance, angle_deg = errors(found.pose, query(seed, variant).pose)
    assert distance < 0.05
    assert angle_deg < 1.0
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
    np.testing.assert_array_equal(one.pose.center_world, two.pose.center_world)
    np.testing.assert_array_equal(one.pose.R_cam_from_world, two.pose.R_cam_from_world)
    assert (one.loss, one.evidence, one.confidence) == (two.loss, two.evidence, two.confidence)


@pytest.mark.parametrize("name", ["room 1", "black", "noise"])
def test_panorama_from_elsewhere_is_not_localized(name):
    noise = np.random.default_rng(0).integers(0, 256, (256, 512, 3), dtype=np.uint8)
    rgb = {"room 1": query(1).rgb, "black": np.zeros_like(noise), "noise": noise}[name]
    found = localize(prepare(room(2)[1], QUICK), as_panorama(rgb), QUICK, Workers(2), Stopwatch())
    assert found.status == "not_localized"


def test_panorama_of_which_nothing_counts_has_no_pose():
    panorama = as_panorama(query(1).rgb)
    masked = dataclasses.replace(panorama, is_valid=np.zeros_like(panorama.is_valid))
    found = localize(prepare(room(1)[1], QUICK), masked, QUICK, Workers(1), Stopwatch())
    assert found.status == "not_localized"
    assert found.pose is None


def test_golden_poses():
    """Where the descent has ended: before, processors differ by a centimetre."""
    settled = dataclasses.replace(QUICK, num_iterations=300)
    check_golden_poses(
        "paper.json",
        lambda seed: [prepare(room(seed)[1], QUICK).positions],
        lambda seed, variant: _localize(seed, variant, settled)[0],
    )


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
def test_settings_that_mean_nothing_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(PaperSettings(), **change)


def test_rotations_default_to_the_papers():
    assert PaperSettings().effective_num_rotations == 8
    assert PaperSettings(gravity="unknown").to_json()["num_rotations"] == 32


def test_the_preset_paper_goes_by_margin_and_agreement():
    """From the weights as they were fitted, by a pocket calculator."""
    evidence = Evidence(0.15, 0.15, 0.4, 0.85, 0.93)
    assert paper_confidence(evidence) == pytest.approx(0.1759, abs=0.001)
    clearer = Evidence(0.15, 0.25, 0.5, 0.85, 0.93)
    assert paper_confidence(clearer) > paper_confidence(evidence)
