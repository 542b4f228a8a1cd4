"""Importing this lets the scripts beside it import their own checkout, without an install."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def run(name: str, module: str) -> None:
    """Run the command in `module`, unless the script of this `name` is only imported."""
    if name == "__main__":
        from piccolo.cli import start  # noqa: PLC0415  from the checkout, as set above

        sys.exit(start.run(module))
