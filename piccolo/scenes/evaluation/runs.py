"""A run over scenes on disk, one JSON line a query, appended as it comes, so that a stopped one goes on."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...batch.results_file import check_as_expected
from ...errors import InputError
from ...files.json_file import parse_lines, read_bytes
from ...files.line_file import whole_size
from ..scene import QUERIES_NAME, Query, Scene
from .query_result import FORMAT, QueryResult, query_result_of

WANTED = "wanted a run of tools/evaluate.py"
LINE_BEGINS = f'{{"format": "{FORMAT}"'.encode()
MAX_DIFFERENCE = 1e-6  # [m], [rad] between errors of the same poses


def read_run(path: Path) -> tuple[list[QueryResult], int]:
    """Return the queries of a run, and the size [byte] of the file up to its last whole line.

    Raises InputError if a line is none of a run; an unfinished last line was being written, and is left out.
    """
    content = read_bytes(path, WANTED)
    size = whole_size(path, LINE_BEGINS, "a run of tools/evaluate.py")
    rows = parse_lines(path, content[:size], QueryResult.from_json)
    return list({row.key: row for row in rows}.values()), size


def check_run(
    path: Path, rows: Sequence[QueryResult], scenes: Sequence[Scene], expected: Mapping[str, Any]
) -> None:
    """Refuse rows that were made with other settings than the expected, other true poses or other scenes."""
    queries = {(s.name, s.name_of(query)): (s, query) for s in scenes for query in s.queries}
    for row in rows:
        found = {"line": path, "settings": row.result.settings}
        check_as_expected(found, expected, "choose another file")
        if row.key in queries and not _is_of(row, *queries[row.key]):
            text = "made with another true pose or another scene of this name; choose another file"
            raise InputError(f"{path}: found a result of {row.scene}, {row.image} {text}")


def _is_of(row: QueryResult, scene: Scene, query: Query) -> bool:
    """True if a result's errors are those of its pose against this query's true pose."""
    again = query_result_of(scene, query, row.result, row.is_in_box)
    pairs = (row.position_error, again.position_error), (row.rotation_error, again.rotation_error)
    return all(a == b or abs(a - b) < MAX_DIFFERENCE for a, b in pairs)


def check_variants(scenes: Sequence[Scene], variants: Sequence[str]) -> None:
    """Refuse variants that no query of the scenes has."""
    known = {query.variant for scene in scenes for query in scene.queries}
    if missing := [variant for variant in variants if variant not in known]:
        raise InputError(f"--variants: found no {missing[0]}, wanted some of {', '.join(sorted(known))}")


def input_files(scenes: Sequence[Scene]) -> list[Path]:
    """Return the files of scenes, which no output may replace."""
    of_all = [path for scene in scenes for path in (scene.folder / QUERIES_NAME, scene.cloud)]
    queries = [query for scene in scenes for query in scene.queries]
    return of_all + [path for query in queries for path in (query.image, query.labels) if path]
