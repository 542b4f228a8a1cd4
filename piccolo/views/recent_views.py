"""Views from places on a grid, the last few kept: a pose that hardly moves sees what it saw before."""

from functools import lru_cache, partial

from ..cloud.octree import Octree
from ..geometry.pose import Pose
from .points_around import points_around, visible_points
from .view import average_view

SPACING = 0.01  # [m] between places
NUM_VIEWS = 32  # are kept: 12 MB
NUM_POINT_SETS = 8  # 7 MB
NUM_SURROUNDINGS = 2  # 11 MB
Place = tuple[float, float, float]  # [m] in the map


class RecentViews:
    """Views of one scan, each made when it is asked for and not among the last; from any thread."""

    def __init__(self, octree: Octree) -> None:
        self.averages = lru_cache(NUM_VIEWS)(partial(average_view, octree))
        self.points = lru_cache(NUM_POINT_SETS)(partial(visible_points, octree))
        self.surroundings = lru_cache(NUM_SURROUNDINGS)(partial(points_around, octree))


def place_of(pose: Pose) -> Place:
    """The place nearest to a pose of the map."""
    x, y, z = (round(float(value) / SPACING) * SPACING for value in pose.center_world)
    return x, y, z
