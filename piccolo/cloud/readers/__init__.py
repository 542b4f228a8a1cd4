"""Readers of point clouds, a file for each format."""
