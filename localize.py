#!/usr/bin/env python3
"""Command line: a coloured scan and 360-degree photos in, camera poses out."""

import sys

from piccolo.cli.start import run

if __name__ == "__main__":
    sys.exit(run("piccolo.cli.localize"))
