#!/usr/bin/env python3
"""List the images inside an E57 file, one JSON object a line, and write them as files if asked."""

from _checkout import run

run(__name__, __file__)
