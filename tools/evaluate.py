#!/usr/bin/env python3
"""Localize the panoramas of scenes with true poses, and measure how good the poses are."""

from _checkout import run

run(__name__, __file__)
