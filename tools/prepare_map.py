#!/usr/bin/env python3
"""Prepare a cloud once: the map file that localize.py takes in place of the cloud."""

import _checkout  # noqa: F401

from piccolo.cli.prepare_map import main

if __name__ == "__main__":
    raise SystemExit(main())
