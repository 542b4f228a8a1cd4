"""Results on disk, one line a panorama, appended as they come, so that a stopped batch goes on."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..result import FORMAT
from ..runtime.line_file import whole_lines, whole_size

LINE_BEGINS = f'{{"format": "{FORMAT}"'.encode()
WAYS = "--overwrite starts anew, another --out keeps both"
# What a finished line must have in common with the one that would be written now, the most telling first.
KEYS = ("pano", "pano_sha256", "cloud_sha256", "cloud", "settings", "version")


def finished_lines(path: Path) -> tuple[Iterator[dict[str, Any]], int]:
    """The fields of each whole line that an earlier run has left, and their size [byte].

    Raises
    ------
    InputError
        The file is none of results: at once if its end is not, or when the iterator comes to it.
    """
    size = whole_size(path, LINE_BEGINS, f"results of localize.py: {WAYS}")

    def parsed() -> Iterator[dict[str, Any]]:
        for number, line in enumerate(whole_lines(path, size), 1):
            try:
                fields = json.loads(line)
                found = fields["format"]
            except (ValueError, KeyError, TypeError, RecursionError) as error:
                raise InputError(f"{path}, line {number}: no result of localize.py; {WAYS}") from error
            if found != FORMAT:
                raise InputError(f"{path}, line {number}: of format {found!r}, not {FORMAT!r}; {WAYS}")
            yield {**fields, "line": f"{path}, line {number}"}

    return parsed(), size


def check_finished(fields: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """InputError for a finished line that is not of the panorama, scan and settings `expected` there."""
    different = next((key for key in KEYS if fields.get(key) != expected[key]), None)
    if different is None:
        return
    found, wanted = fields.get(different), expected[different]
    if different == "settings" and isinstance(found, dict):
        name = next(name for name in sorted({*found, *wanted}) if found.get(name) != wanted.get(name))
        found, wanted, different = found.get(name), wanted.get(name), name
    text = {
        "pano": f"of {found}, where this command has {wanted}",
        "pano_sha256": f"{fields['pano']} has changed since",
        "cloud_sha256": "made with another scan, or the scan has changed since",
    }.get(different, f"made with {different} {found!r}, not {wanted!r}")
    raise InputError(f"{fields['line']}: {text}; {WAYS}")
