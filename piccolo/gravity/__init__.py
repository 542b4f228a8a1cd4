"""Which way is up in a cloud, from its own planes."""

from .up import Up, find_up, rotation_to_z_up

__all__ = ["Up", "find_up", "rotation_to_z_up"]
