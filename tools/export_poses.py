#!/usr/bin/env python3
"""Write the poses of localize.py as files of other tools: COLMAP, nerfstudio, OpenSfM, trajectories, maps."""

from _checkout import run

run(__name__, __file__)
