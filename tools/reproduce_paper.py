#!/usr/bin/env python3
"""The paper's experiments on scenes with true poses: a table beside the paper's figures, and a plot."""

from _checkout import run

run(__name__, __file__)
