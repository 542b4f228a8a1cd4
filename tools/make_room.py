#!/usr/bin/env python3
"""Make a seeded furnished room: a coloured scan of it, and panoramas with true poses."""

import _checkout  # noqa: F401

from piccolo.cli.make_room import main

if __name__ == "__main__":
    raise SystemExit(main())
