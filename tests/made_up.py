"""Made-up hypotheses and what speaks for them, for tests in which one rule decides."""

from types import SimpleNamespace

import numpy as np

from piccolo.confidence.alternatives import Hypothesis
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.jobs.threads import Workers
from piccolo.localization import localize as method
from piccolo.localization import standings
from piccolo.localization.comparison import Comparison
from piccolo.localization.config import METHOD
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.optimize.channel_loss import CHANCE

OF_MAP = SimpleNamespace(octree=None)
VIEWS = SimpleNamespace(averages=lambda *_: None, points=lambda *_: None, surroundings=lambda *_: None)
QUERY = SimpleNamespace(
    workers=Workers(1),
    method=METHOD,
    scan_map=OF_MAP,
    by_features=True,
    views=VIEWS,
    settings=CoarseToFineSettings(),
)


def at(x, score, yaw_deg=0.0):
    return Hypothesis(Pose(yaw_rotation(np.radians(yaw_deg)), np.array([x, 0.0, 0.0])), score)


def places(hypotheses):
    return [round(float(h.pose.center_world[0]), 6) for h in hypotheses]


def seen(explains, num_blocks=4):
    """A comparison that explains a part of each of some blocks of a hundredth of the sphere."""
    beyond = CHANCE + (1.0 - CHANCE) * explains
    area = np.full(num_blocks, 0.01)
    return Comparison(np.full(num_blocks, beyond), area, area, 0.04)


def compared(monkeypatch, explains, counts):
    """Made-up comparisons and matches, by the x of a pose."""
    query = SimpleNamespace(**vars(QUERY), matches=None)
    for module in (method, standings):
        count = lambda matches, pose: counts.get(pose.center_world[0], 0)  # noqa: E731
        monkeypatch.setattr(module, "count_matches", count)
    monkeypatch.setattr(standings, "compare", lambda query, pose: seen(explains[pose.center_world[0]]))
    return query
