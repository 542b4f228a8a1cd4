"""The stages on which a pose is refined, from coarse images and views to single points: one table."""

from typing import Literal, NamedTuple

ViewName = Literal["prepared", "middle", "fine", "points"]
ImageName = Literal["full", "fine", "middle", "search"]
NEARLY = 0.02  # [m] a camera that moved by less than this sees the same points


class Limits(NamedTuple):
    """The scale of a descent's loss, and the limits at which it ends."""

    loss_scale: float  # [standard deviations]
    num_iterations: int  # at most
    tolerance: float  # [rad + m] a shorter step ends the descent


class Around(NamedTuple):
    """Perturbed poses around the given one: each descends on a coarser image first; the best end goes on."""

    image: ImageName
    num_iterations: int  # on that image
    size: float  # of the perturbations, relative to `perturbed_distance` and `perturbed_angle` of the method


class Rounds(NamedTuple):
    """Repetitions of a descent, each on the points visible from where the one before ended."""

    most: int
    arrived: float  # [m] a smaller move ends them


class Stage(NamedTuple):
    """A descent from a pose: the scan's view and the photo's image that are compared, and its limits."""

    view: ViewName
    image: ImageName
    limits: Limits
    around: Around | None = None
    rounds: Rounds = Rounds(1, 0.0)


FIRST = Stage("prepared", "search", Limits(1.2, 5, 2e-3))
SECOND = Stage("prepared", "search", Limits(1.2, 12, 2e-3))
MIDDLE = Stage("middle", "middle", Limits(1.2, 12, 1e-3))
AROUND_MIDDLE = Stage("middle", "middle", Limits(1.2, 8, 1e-3), Around("search", 6, 1.0))
AROUND_FINE = Stage("fine", "fine", Limits(1.2, 8, 1e-3), Around("middle", 6, 0.4))
FINE = Stage("fine", "fine", Limits(1.0, 12, 1e-4))
SOFT = Stage("points", "fine", Limits(1.0, 12, 1e-4))  # of edges, before the first descent on a finer image
FULL = Stage("points", "full", Limits(0.7, 10, 1e-4), rounds=Rounds(2, NEARLY))
LAST = Stage("points", "full", Limits(0.7, 30, 1e-7), rounds=Rounds(6, 1e-4))
