"""Poses, rotations and the spherical camera."""
