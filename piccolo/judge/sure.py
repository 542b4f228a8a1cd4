"""Thresholds of the probability that a pose is right, from which it is used or shown.

Whether a photo is localized follows from the user's `accuracy` and `min_confidence`. Thresholds of scores are
in `problem.method`.
"""

from ..problem.method import METHOD

SURE_ODDS = METHOD.sure_odds  # [log] least odds of a frame or a photo by which others are placed
SURE_CONFIDENCE = 0.95  # about the same threshold as a confidence
WORTH_A_LOOK = 0.1  # probability of a place: below it, no message asks the user to look at the best pose
SHOWN = 0.05  # probability of a place: below it, no plan shows the best pose of a photo that is not localized
