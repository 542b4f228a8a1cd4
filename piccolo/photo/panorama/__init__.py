"""Panoramas read from pictures of any format and shape, always as full spheres, with masks."""

from .panorama import GPano, Panorama
from .read import panorama_size, read_panorama

__all__ = ["GPano", "Panorama", "panorama_size", "read_panorama"]
