#!/usr/bin/env python3
"""Localize the panoramas of scenes with true poses, and measure how good the poses are."""

import _checkout  # noqa: F401

from piccolo.cli.evaluate import main

if __name__ == "__main__":
    raise SystemExit(main())
