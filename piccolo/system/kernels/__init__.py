"""Compiling with Numba, once a machine."""
