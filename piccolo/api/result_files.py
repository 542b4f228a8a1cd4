"""Results in files of JSON lines."""

import math
import re
from collections.abc import Sequence
from pathlib import Path

from ..judge.result import Result
from ..scan_map.open_map import CachePolicy, scan_sha256_of
from ..system.errors import UNPRINTABLE, InputError
from ..system.files.json_file import parse_lines, read_bytes

NO_NAME = re.compile("[\ud800-\udc7f\udd00-\udfff]")  # characters that os.fsdecode never returns
WANTED = "wanted JSON lines of localize.py"


def read_results(paths: Sequence[Path]) -> list[Result]:
    """Return the results in files of JSON lines, with their poses checked.

    Raise InputError if a line is not a result, or a file has none.
    """
    results = []
    for path in paths:
        in_file = parse_lines(path, read_bytes(path, WANTED), _parse_result)
        if not in_file:
            raise InputError(f"{path}: found no result, {WANTED}")
        results += in_file
    return results


def check_scan(results: Sequence[Result], cloud_sha256: str, scan: str, is_forced: bool) -> str:
    """Check that results are of the scan with a digest.

    If some are not, raise InputError, or with `is_forced` return words on them for a warning; else return "".
    """
    others = [r for r in results if r.source.cloud_sha256 not in (None, cloud_sha256)] if cloud_sha256 else []
    if not others:
        return ""
    words = f"found {len(others)} of {len(results)} results of another scan than {scan}"
    if not is_forced:
        first = f"the first of {others[0].cloud_name}"
        raise InputError(f"{others[0].pano}: {words}, {first}, wanted this scan, or `force`")
    return words


def digest_of_scan(paths: Sequence[Path]) -> str:
    """Return the digest of a scan's files; for a prepared map, of the files from which it was made."""
    return scan_sha256_of(paths, CachePolicy())


def _parse_result(text: str) -> Result:
    """Return the result in a line. Raise InputError for names and numbers that could not be written again."""
    result = Result.from_json(text)
    texts = {"status": result.status, "cloud": result.cloud_name, "scan": result.scan or ""}
    for label, value in texts.items():
        if UNPRINTABLE.search(value):
            raise InputError(f"result: found {label} {value!r}, wanted text on one line")
    if NO_NAME.search(result.pano):
        raise InputError(f"result: found pano {result.pano!r}, wanted a file's name as os.fsdecode gives it")
    values = [result.confidence, *([result.evidence.score] if result.evidence else [])]
    if not all(map(math.isfinite, values)):
        raise InputError(f"result: found confidence and score {values}, wanted finite numbers")
    return result
