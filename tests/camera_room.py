"""A room of which photos are rendered, its scan, and the poses from which they are taken."""

import functools

import rooms

from piccolo.system.jobs.threads import Workers
from research.synthetic.world import make_query, pose_of_query

SEED = 5
TRUE = 160.0  # [px] the focal length of photos of 320 x 240 pixels
DENSE = 400_000  # points of a room whose photos tell their focal length to a per cent


def scan():
    return rooms.scan(SEED)


@functools.lru_cache
def place(index=2):
    """The room as a query finds it, and the query's pose in the world; some cost the search much time."""
    world = rooms.room(SEED)[0]
    this, _, _ = pose_of_query(world, index, "clean")
    return this, make_query(world, index, "clean", 128, Workers(2)).pose
