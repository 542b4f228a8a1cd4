#!/usr/bin/env python3
"""Draw the cloud as a camera at a pose would see it: colours, depth, or a descent towards the pose."""

from _checkout import run

run(__name__, __file__)
