#!/usr/bin/env python3
"""Draw the sampling loss over a plan of the cloud: its least value over height and rotation at each place."""

from _checkout import run

run(__name__, __file__)
