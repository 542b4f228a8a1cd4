"""What is seen from places on a grid, the last few kept: a pose that hardly moves sees what it saw before."""

from functools import lru_cache, partial
from typing import NamedTuple, Protocol

import numpy as np

from ..cloud.octree import Octree
from ..cloud.soa import PackedPoints
from ..geometry.pose import Pose
from .points_around import points_around, visible_points
from .view import Array32, Cells, ViewConfig, average_view

SPACING = 0.01  # [m] between places
NUM_VIEWS, NUM_POINT_SETS, NUM_SURROUNDINGS = 32, 8, 2  # are kept: 12, 7 and 11 MB
Place = tuple[float, float, float]  # [m] in the map


class AveragesFrom(Protocol):
    """What `view.average_view` tells of a place."""

    def __call__(self, place: Place, config: ViewConfig, /) -> Array32:
        """Sums (cells, 8)."""


class PointsFrom(Protocol):
    """What `points_around.visible_points` tells of a place."""

    def __call__(self, place: Place, config: ViewConfig, shown: bytes, count: int, /) -> Cells:
        """At most `count` points, in the cells that are shown: a byte each."""


class SurroundingsOf(Protocol):
    """What `points_around.points_around` tells of a place."""

    def __call__(self, place: Place, voxel_per_range: float, /) -> PackedPoints:
        """Coloured points."""


class RecentViews(NamedTuple):
    """Views of one scan; from any thread."""

    averages: AveragesFrom
    points: PointsFrom
    surroundings: SurroundingsOf


def recent_views(octree: Octree) -> RecentViews:
    """Views of a scan, each made when it is asked for and not among the last."""

    def points(place: Place, config: ViewConfig, shown: bytes, count: int) -> Cells:
        return visible_points(octree, place, config, np.frombuffer(shown, np.bool_), count)

    def surroundings(place: Place, voxel_per_range: float) -> PackedPoints:
        return points_around(octree, np.array(place), voxel_per_range)

    averages = lru_cache(NUM_VIEWS)(partial(average_view, octree))
    return RecentViews(averages, lru_cache(NUM_POINT_SETS)(points), lru_cache(NUM_SURROUNDINGS)(surroundings))


def place_of(pose: Pose) -> Place:
    """The place nearest to a pose of the map."""
    x, y, z = (round(float(value) / SPACING) * SPACING for value in pose.center_world)
    return x, y, z
