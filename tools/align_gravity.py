#!/usr/bin/env python3
"""Turn a coloured scan so that z is up: find up from its planes, write the cloud and the 4 x 4 transform."""

from _checkout import run

run(__name__, __file__)
