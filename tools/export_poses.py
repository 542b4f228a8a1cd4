#!/usr/bin/env python3
"""Write the poses of localize.py as files of other tools: COLMAP, nerfstudio, OpenSfM, trajectories, maps."""

import _checkout  # noqa: F401

from piccolo.cli.export_poses import main

if __name__ == "__main__":
    raise SystemExit(main())
