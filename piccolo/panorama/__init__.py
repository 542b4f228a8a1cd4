"""Panoramas read from files of any format and shape, always as full spheres; masks and sizes."""

from .model import GPano, Panorama, ReadOptions
from .read import AS_STORED, panorama_of_array, panorama_size, read_panorama, read_photo

__all__ = [
    "AS_STORED",
    "GPano",
    "Panorama",
    "ReadOptions",
    "panorama_of_array",
    "panorama_size",
    "read_panorama",
    "read_photo",
]
