"""Readers of point clouds, one file a format."""
