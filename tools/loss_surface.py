#!/usr/bin/env python3
"""Draw the sampling loss over a plan of the cloud: its least value over height and rotation at each place."""

import _checkout  # noqa: F401

from piccolo.cli.loss_surface import main

if __name__ == "__main__":
    raise SystemExit(main())
