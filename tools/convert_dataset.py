#!/usr/bin/env python3
"""Write research datasets, or your own panoramas with known poses, as scenes that tools/evaluate.py reads."""

from _checkout import run

run(__name__, __file__)
