#!/usr/bin/env python3
"""List the images inside an E57 file, one JSON object a line, and write them as files if asked."""

import _checkout  # noqa: F401

from piccolo.cli.e57_images import main

if __name__ == "__main__":
    raise SystemExit(main())
