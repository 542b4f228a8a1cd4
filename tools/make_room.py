#!/usr/bin/env python3
"""Make a seeded furnished room: a coloured scan of it, and panoramas with true poses."""

from _checkout import run

run(__name__, __file__)
