#!/usr/bin/env python3
"""Draw the cloud as a camera at a pose would see it: colours, depth, or a descent towards the pose."""

import _checkout  # noqa: F401

from piccolo.cli.render_pose import main

if __name__ == "__main__":
    raise SystemExit(main())
