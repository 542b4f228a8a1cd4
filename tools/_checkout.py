"""Importing this lets the scripts beside it import `piccolo` from their own checkout, without an install."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def run(name: str, file: str) -> None:
    """Run the command of piccolo.cli that the script `file` is named after, unless it is only imported."""
    if name == "__main__":
        from piccolo.cli import start  # noqa: PLC0415  from the checkout, as set above

        sys.exit(start.run(Path(file).stem))
