#!/usr/bin/env python3
"""Turn a coloured scan so that z is up: find up from its planes, write the cloud and the 4 x 4 transform."""

import _checkout  # noqa: F401

from piccolo.cli.align_gravity import main

if __name__ == "__main__":
    raise SystemExit(main())
