"""The numbers by which the default method decides, in one place; results repeat them with their settings."""

import math
from dataclasses import dataclass

from ..system.arguments import check_fields


@dataclass(frozen=True)
class Method:
    """Thresholds and counts of the default method.

    Where no source is named a number was chosen by hand. `tools/benchmark.py sensitivity` moves each of them
    by a fifth and counts what changes. Kinds of photos differ by their `Profile`.
    """

    # the search
    first_starts: int = 300  # of a brief search: few are enough for a clear photo
    candidates_per_start: int = 2  # of a whole photo: where there are few candidates it has fewer starts
    poses_per_start: int = 12  # that go on from wide cells to non-maximum suppression
    scored_starts: int = 64  # that descend, if only the best score is needed
    first_mirror_ratio: float = 1.1  # least ratio of first scores, photo to mirrored photo
    clear_margin: float = 0.5  # least lead of a pose that ends the search by whole views alone

    # the refinement
    faint_part: float = 0.25  # of the best score of a search: poses with less are dropped
    most_found: int = 12  # poses of a search
    perturbed_distance: float = 0.25  # [m] to poses around one that is refined
    perturbed_angle: float = math.radians(8.0)  # [rad]
    most_perturbations: int = 5  # rounds
    least_gain: float = 0.02  # of the score in a round, relative; a round with less is the last
    near_score: float = 0.6  # an alternative with this fraction of the best score is refined like the best

    # matches of local features
    most_matched: int = 6  # poses from matches with features of the map that are refined
    enough_matches: int = 40  # of a part of the features: if the pose is sure, the others are not asked
    agree_angle: float = math.radians(0.5)  # [rad] matches with a smaller error agree with a pose
    chance_matches: int = 6  # may agree with a wrong pose, mostly none do
    # agree with a right pose; wrong ones have about 5, in repeated places more, but then several poses do
    sure_matches: int = 12

    # the choice
    faint_score: float = 0.1  # a pose with less ends no search: the scan is not drawn to see if it is sure
    rival_score: float = 0.5  # of a sure pose's score: with less no other can win
    sure_odds: float = 3.0  # [log] 20 to 1, of the best pose against each other: ends the search
    least_ratio: float = 0.1  # of a pose's explained part to the best one's; a lesser one counts as this
    noise_matches: int = 8  # added to the number that agree, as so many may by chance

    # errors and doubts
    pixel_share: float = 0.04  # of a pixel that is left in a pose, by trials with photos of 256 and 2048 px
    uncalibrated_share: float = 0.15  # the same of photos with unknown principal point and distortion
    # of halves that disagree: 1 in the mean by chance; of the best of nine planes more in a quarter of photos
    halves_score: float = 3.0
    edge_error: float = 0.2  # [px] of the sphere at the picture's edge, which all blocks may have in common
    clear_deviations: float = 2.5  # by which matches must tell another focal length

    # mirrored photos
    worth_asking: float = 0.2  # least probability of all poses together for which the mirrored photo is tried
    enough_explained: float = 0.7  # with this score and `enough_matches` a photo is not mirrored
    mirror_ratio: float = 1.05  # least ratio of scores, mirrored photo to photo

    def __post_init__(self) -> None:
        """Refuse values of a wrong type, naming them."""
        check_fields(self)

    @property
    def cos_agree(self) -> float:
        """Cosine of `agree_angle`."""
        return math.cos(self.agree_angle)


METHOD = Method()
