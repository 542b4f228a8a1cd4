#!/usr/bin/env python3
"""The paper's experiments on scenes with true poses: a table beside the paper's figures, and a plot."""

import _checkout  # noqa: F401

from piccolo.cli.reproduce_paper import main

if __name__ == "__main__":
    raise SystemExit(main())
