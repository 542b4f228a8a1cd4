#!/usr/bin/env python3
"""Prepare a cloud once: the map file that localize.py takes in place of the cloud."""

from _checkout import run

run(__name__, __file__)
