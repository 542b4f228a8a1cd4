"""Two phone photos of a real corridor, localized in a part of its scan (tests/data/corridor)."""

import math
from pathlib import Path

import pytest

import piccolo
from piccolo.geometry.pose import pose_errors
from research.scene import read_scene

TIER = "process"

CORRIDOR = read_scene(Path(__file__).parent / "data" / "corridor")


@pytest.fixture(scope="module")
def scan():
    return piccolo.open_scan(CORRIDOR.cloud, cache=False)


@pytest.mark.parametrize("query", CORRIDOR.queries, ids=lambda query: query.image.stem)
def test_best_pose_of_a_photo_in_a_real_corridor_is_right(query, scan):
    camera = CORRIDOR.folder / "cameras" / f"{query.image.stem}.camera.json"
    result = scan.localize(piccolo.Photo(query.image, camera=camera))
    distance, angle = pose_errors(result.best_pose, query.pose)
    assert distance < 0.1  # [m]; found: 0.039 and 0.015, of which the true poses may be off by 0.02
    assert math.degrees(angle) < 1.0  # found: 0.34
    assert distance < 3.0 * math.hypot(result.covariance.largest_std, 0.02)  # [m] of the reference
    assert result.confidence > 0.5
