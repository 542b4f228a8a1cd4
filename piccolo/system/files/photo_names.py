"""Photos by the names that other files give them."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import takewhile
from operator import eq
from pathlib import Path, PurePosixPath
from typing import TypeVar

from ..errors import InputError

Value = TypeVar("Value")


def match_names(
    path: Path, named: Sequence[tuple[str, Value]], photos: Sequence[Path], what: str = "poses"
) -> list[Value | None]:
    """Return the pose, or what else is named, of each photo by the end of its path or by its stem.

    Raises InputError if two that differ fit alike.
    """
    by_name = defaultdict[str, list[tuple[tuple[str, ...], Value]]](list)
    for name, value in named:
        parts = PurePosixPath(name.replace("\\", "/")).parts or ("",)
        by_name[parts[-1]].append((parts[::-1], value))
    chosen: list[Value | None] = []
    for photo in photos:
        own = photo.parts[::-1]
        found = by_name.get(photo.name) or by_name.get(photo.stem) or []
        lengths = [sum(1 for _ in takewhile(bool, map(eq, own[1:], parts[1:]))) for parts, _ in found]
        values = [value for (_, value), length in zip(found, lengths, strict=True) if length == max(lengths)]
        if any(value != values[0] for value in values):
            raise InputError(f"{path}: found {len(values)} {what} of {photo}, wanted one of each photo")
        chosen.append(values[0] if values else None)
    return chosen
