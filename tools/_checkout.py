"""Importing this lets the scripts beside it import `piccolo` from their own checkout, without an install."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
