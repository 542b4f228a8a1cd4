"""The cloud files in a dataset's folders."""

from pathlib import Path

from ...cloud import FORMATS
from ...errors import InputError

SUFFIXES = frozenset().union(*(f.suffixes for f in FORMATS)) - {".csv"}  # as these hold poses too


def is_cloud(path: Path) -> bool:
    """True for a file whose name ends as that of a cloud format."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def only_cloud_in(folder: Path) -> Path | None:
    """The one cloud in a folder, None if there is none. InputError if there are several."""
    named = sorted(path for path in folder.glob("cloud.*") if is_cloud(path))
    found = named or sorted(path for path in folder.iterdir() if is_cloud(path) and path.suffix != ".txt")
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"{folder}: found the clouds {names}; leave one, or name one of them cloud.*")
    return found[0] if found else None
