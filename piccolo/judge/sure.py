"""Thresholds of the odds that a pose is right: from which it is sure enough for what.

What counts as localized is the user's `accuracy` and `min_confidence`. Thresholds of scores are in
`problem.method`.
"""

from ..problem.method import METHOD

SURE_ODDS = METHOD.sure_odds  # [log] a frame or a photo with them helps others
SURE_CONFIDENCE = 0.95  # about the same of a confidence
WORTH_A_LOOK = 0.1  # probability of the place: below it a user is not asked to look at the best pose
SHOWN = (
    0.05  # probability of the place of a photo that is not localized: below it no plan shows its best pose
)
