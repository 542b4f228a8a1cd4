"""Made-up hypotheses and what speaks for them, for tests in which one rule decides."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from piccolo.localization.query import Cache, Features, Query

from piccolo.confidence.alternatives import Hypothesis
from piccolo.evidence.comparison import FINE_VIEW, Comparison
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.jobs.threads import Once, Workers
from piccolo.judge import selection
from piccolo.local_features.keypoints import join_keypoints
from piccolo.local_features.matching import NO_MATCHES
from piccolo.localization import last_descent
from piccolo.optimize.channel_loss import CHANCE
from piccolo.problem.settings import CoarseToFineSettings

WHOLE = SimpleNamespace(is_partial=False, has_tilt=False)  # photos, of which nothing else is asked
PARTIAL = SimpleNamespace(is_partial=True, has_tilt=False)
TILTED_WHOLE = SimpleNamespace(is_partial=False, has_tilt=True)
TILTED_PARTIAL = SimpleNamespace(is_partial=True, has_tilt=True)
VIEWS = SimpleNamespace(averages=lambda *_: None, points=lambda *_: None, surroundings=lambda *_: None)
NO_FEATURES = Once(lambda: Features(join_keypoints([]), NO_MATCHES))
QUERY = Query(
    source=None,
    given=None,
    photo=WHOLE,
    colors=lambda: None,
    scan_map=SimpleNamespace(octree=None, to_world=lambda pose: pose, has_shape=False),
    settings=CoarseToFineSettings(),
    workers=Workers(1),
    features=(NO_FEATURES, NO_FEATURES),
    evidence="drawn scan",
    cache=Cache(VIEWS),
)


def at(x, score, yaw_deg=0.0):
    return Hypothesis(Pose(yaw_rotation(np.radians(yaw_deg)), np.array([x, 0.0, 0.0])), score)


def place(pose):
    return round(float(pose.center_world[0]), 6)


def places(hypotheses):
    return [place(h.pose) for h in hypotheses]


def seen(explains, num_blocks=4):
    """A comparison that explains a part of each of some blocks of a hundredth of the sphere."""
    beyond = CHANCE + (1.0 - CHANCE) * explains
    area = np.full(num_blocks, 0.01)
    return Comparison(np.full(num_blocks, beyond), area, area, 0.01 * num_blocks)


def compared(monkeypatch, explains, counts):
    """A query with made-up comparisons, and made-up counts of matches, by the x of a pose."""

    def count_each(query, best, others):
        return [counts.get(place(h.pose), 0) for h in (best, *others)]

    for module in (selection, last_descent):
        monkeypatch.setattr(module, "count_each", count_each)
    known = {(at(x, 0.0).pose.key, FINE_VIEW): seen(part) for x, part in explains.items()}
    return replace(QUERY, cache=Cache(VIEWS, known))
