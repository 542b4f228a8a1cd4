"""The numbers by which the default method decides, in one place; each result lists them with its settings."""

import math
from dataclasses import dataclass

from ..system.arguments import check_fields


@dataclass(frozen=True)
class Method:
    """Thresholds and counts of the default method.

    A number without a named source was chosen by hand. `tools/benchmark.py sensitivity` changes each number
    by a fifth and counts which results change. What depends on the kind of photo is in `Profile`.
    """

    # the search
    first_starts: int = 300  # starts of a brief search: few are enough for a clear photo
    candidates_per_start: int = 2  # a whole photo has at most one start for so many candidates
    poses_per_start: int = 12  # poses by wide cells that suppression thins out to one start
    scored_starts: int = 64  # starts that descend where only the best score is needed
    first_mirror_ratio: float = 1.1  # least ratio of the first look's scores, photo to mirrored photo
    clear_margin: float = 0.5  # least margin of a pose that ends the search by whole views alone

    # the refinement
    faint_part: float = 0.25  # poses with less than this fraction of a search's best score are dropped
    most_found: int = 12  # poses that a search returns, at most
    perturbed_distance: float = 0.25  # [m] from a pose to the perturbed ones that are refined with it
    perturbed_angle: float = math.radians(8.0)  # [rad] the same for rotations
    most_perturbations: int = 5  # rounds of perturbing and refining, at most
    least_gain: float = 0.02  # relative gain of the score in a round; a round that gains less is the last
    near_score: float = 0.6  # an alternative with this fraction of the best score is refined like the best

    # matches of local features
    most_matched: int = 6  # poses proposed by matches with the map's pictures that are refined, at most
    enough_matches: int = 40  # a pose with so many is tried before all pictures are drawn
    agree_angle: float = math.radians(0.5)  # [rad] a match with a smaller error agrees with a pose
    chance_matches: int = 6  # so many matches may agree with a wrong pose by chance; mostly none does
    # least number that agrees with a right pose. About 5 agree with a wrong one; more in places that repeat,
    # but there with several poses
    sure_matches: int = 12

    # the choice
    faint_score: float = 0.1  # if the best pose has less, the scan is not drawn to see if it is sure
    rival_score: float = 0.5  # another pose with less than this fraction of a sure pose's score can't win
    sure_odds: float = 3.0  # [log] odds, 20 to 1, of the best pose against each other one that end a search
    least_ratio: float = 0.1  # of what a pose explains to what the best one does; less counts as this
    noise_matches: int = 8  # added to the number of matches that agree, as so many may agree by chance

    # errors and doubts
    pixel_share: float = 0.04  # [px] error that stays in a pose, by trials with photos of 256 and 2048 px
    # least score of halves of a photo that disagree. By chance it is 1 in the mean; the largest for nine
    # planes is above this in a quarter of the photos
    halves_score: float = 3.0
    edge_error: float = 0.2  # [px] of the sphere: error at the picture's edge that all blocks may share
    clear_deviations: float = 2.5  # by which the focal length by matches must differ to be taken

    # mirrored photos
    worth_asking: float = 0.2  # the mirrored photo is tried if all poses together are at least so probable
    enough_explained: float = 0.7  # with this score and `enough_matches` a photo can't be mirrored
    mirror_ratio: float = 1.05  # least ratio of scores, mirrored photo to photo, of one that may be mirrored
    # the same, and the score of the mirrored photo, of one that was turned over, and is searched no further:
    # nine mirrored panoramas had at least 1.2 and 0.69; one of a symmetric hospital as it is had 4.4, 0.22
    turned_over_ratio: float = 1.15
    turned_over_score: float = 0.5
    decoy_ratio: float = 0.7  # the same, of one whose mirror image may fit as well by chance

    def __post_init__(self) -> None:
        """Refuse values of a wrong type; the message names the field."""
        check_fields(self)

    @property
    def cos_agree(self) -> float:
        """Cosine of `agree_angle`."""
        return math.cos(self.agree_angle)


METHOD = Method()
