#!/usr/bin/env python3
"""Write research datasets, or your own panoramas with known poses, as scenes that tools/evaluate.py reads."""

import _checkout  # noqa: F401

from piccolo.cli.convert_dataset import main

if __name__ == "__main__":
    raise SystemExit(main())
