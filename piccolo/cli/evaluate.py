"""Localize the panoramas of scenes with true poses, and measure how good the poses are."""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files.atomic import is_stream, write_atomically
from ..jobs.memory import limit_memory
from ..result import check_scan, read_results
from ..scan_map.open_map import scan_sha256_of
from ..scenes.evaluation import tables
from ..scenes.evaluation.plots import errors_figure, figure_png, risk_figure
from ..scenes.evaluation.query_result import QueryResult, Thresholds, match_results
from ..scenes.evaluation.runs import input_files, read_run
from ..scenes.evaluation.walks import walk_table, walks_of
from ..scenes.scene import Scene, find_scenes
from .command import check_least, command, option
from .errors import EXIT_BAD_INPUT, UsageError, checking_options, print_error, print_note
from .evaluating import run_scenes
from .executing import check_execution
from .options import (
    add_cloud_reading_options,
    add_execution_options,
    add_method_options,
    add_panorama_reading_options,
    cache_from,
    localizer_from,
)
from .outputs import check_distinct, check_outputs, check_suffix, print_report

EPILOG = """\
examples:
  python tools/evaluate.py --scenes datasets/stanford --out run.jsonl --jobs 4
  python tools/evaluate.py --scenes room --results poses.jsonl
  python tools/evaluate.py --compare paper.jsonl run.jsonl

Scenes are folders with a queries.json, a cloud and images, at any depth below --scenes (docs/DATASETS.md).
--out runs the queries that it does not have yet, and appends a line for each as it comes: give the same
command again to resume a run that was stopped. --results are lines of localize.py instead; each belongs to
the query of the same path, or else of the same file name. Tables are Markdown, on stdout (on stderr where
one of the files is stdout).
Walks (make_room.py --walk) have a table with a line each: ATE and RPE are evo's, of localized frames, nothing
aligned, steps over other frames left out. A photo that has no answer is right when refused.
Queries that can't be read, and --results of no query, are named on stderr, and the rest is done before exit
code 3.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    group = parser.add_argument_group("what")
    option(group, "--scenes FOLDER ...", "scenes with true poses")
    option(group, "--variants NAME ...", "only these splits", default=[])
    kind = group.add_mutually_exclusive_group(required=True)
    option(kind, "--out JSONL", "begin this run, or resume it")
    option(kind, "--results JSONL", "results of localize.py")
    option(kind, "--compare JSONL", "two runs, side by side", nargs=2)
    option(group, "--force", "take --results of another scan than a scene's cloud too")
    option(group, "--cache FOLDER", "of prepared maps (default the user's)")
    group = parser.add_argument_group("tables and plots")
    option(group, "--max-distance M", "correct is under", default=0.1)
    option(group, "--max-angle DEG", "and under", default=5.0)
    option(group, "--csv FILE", "a line a query; - is stdout, as for the others")
    option(group, "--markdown FILE", "the tables, here too")
    option(group, "--errors PNG", "plot: fraction of queries under each error, and recall over thresholds")
    option(group, "--risk PNG", "plot: fraction wrong over fraction accepted, as the min. confidence falls")
    add_cloud_reading_options(parser.add_argument_group("clouds"))
    add_panorama_reading_options(parser.add_argument_group("panoramas"))
    add_method_options(parser)
    add_execution_options(parser)
    parser.set_defaults(jobs=1)


def check_usage(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go together, and values that are wrong whatever the files hold."""
    if (arguments.scenes is None) == (arguments.compare is None):
        raise UsageError("--scenes goes with --out or --results; --compare stands alone")
    if arguments.compare and (arguments.csv or arguments.risk):
        raise UsageError("--csv, --risk: not with --compare, they show one run")
    if not (0.0 < arguments.max_distance < np.inf and 0.0 < arguments.max_angle < np.inf):
        raise UsageError("--max-distance, --max-angle: wanted numbers above 0")
    check_least(arguments, jobs=1, threads=1)
    check_execution(arguments)
    for option_ in ("errors", "risk"):
        check_suffix(f"--{option_}", getattr(arguments, option_), (".png",))
    if arguments.out and is_stream(arguments.out):
        raise UsageError(f"--out {arguments.out}: a run is read again to be resumed, wanted a file")


def report_of(scenes: Sequence[Scene], rows: Sequence[QueryResult], thresholds: Thresholds) -> str:
    """All tables of one run as Markdown."""
    inside = [row for row in rows if row.is_in_box]
    num_outside = sum(row.is_in_box is False for row in rows)
    found = [tables.per_query(rows), tables.summary_table(rows, thresholds, f"all {len(rows)} queries")]
    if num_outside and inside:
        title = f"without the {num_outside} queries taken outside the cloud's bounding box"
        found.append(tables.summary_table(inside, thresholds, title))
    found.append(tables.threshold_table(rows, thresholds))
    found.append(tables.risk_table(tables.risk_and_coverage(rows, thresholds)))
    if walks := walks_of(scenes, rows):
        found.append(walk_table(walks, thresholds))
    return "\n".join(table.markdown() for table in found)


def write_report(
    arguments: argparse.Namespace, text: str, runs: dict[str, list[QueryResult]], thresholds: Thresholds
) -> None:
    """Print the tables of one run or two, and write them and the plot of their errors if asked for."""
    if arguments.markdown:
        write_atomically(arguments.markdown, text.encode())
    if arguments.errors:
        write_atomically(arguments.errors, figure_png(errors_figure(runs, thresholds)))
    print_report(arguments, outputs_of(arguments), text, end="")


def compare(arguments: argparse.Namespace, thresholds: Thresholds) -> int:
    """Print two runs side by side."""
    runs = [read_run(path)[0] for path in arguments.compare]
    if arguments.variants:
        runs = [[row for row in rows if row.variant in arguments.variants] for rows in runs]
    pairs = tables.pair_up(*runs)
    first, second = names = tuple(str(path) for path in arguments.compare)
    if not pairs:
        raise InputError(f"{first}, {second}: no query in common; compare runs of the same scenes")
    text = tables.side_by_side(pairs, (first, second), thresholds).markdown()
    for path, rows in zip(names, runs, strict=True):
        text += f"\nonly in {path}: {len(rows) - len(pairs)} queries"
    text += f"\n\n{tables.changes(pairs, thresholds).markdown()}"
    both = {first: [pair[0] for pair in pairs], second: [pair[1] for pair in pairs]}
    write_report(arguments, text, both, thresholds)
    return 0


def outputs_of(arguments: argparse.Namespace) -> dict[str, Path | None]:
    """The files beside a run, by option."""
    return {f"--{name}": getattr(arguments, name) for name in ("csv", "markdown", "errors", "risk")}


def check_files(arguments: argparse.Namespace, inputs: list[Path]) -> None:
    """Refuse outputs that would replace an input, a run or each other."""
    given = arguments.results, arguments.mask, arguments.camera, arguments.rig
    more = filter(None, (*given, *(arguments.compare or ())))
    check_distinct({"--out": arguments.out, **outputs_of(arguments)}, [*inputs, *more])
    check_outputs(outputs_of(arguments))


def check_clouds(scenes: Sequence[Scene], rows: Sequence[QueryResult], arguments: argparse.Namespace) -> None:
    """Refuse results of other content than the scenes' clouds have, or with --force say so."""
    for scene in scenes:
        results = [row.result for row in rows if row.scene == scene.name and row.result.source.cloud_sha256]
        if results and scene.cloud.is_file():
            digest = scan_sha256_of([scene.cloud], cache_from(arguments))
            if note := check_scan(results, digest, str(scene.cloud), arguments.force):
                print_note(arguments, f"warning: {note}")


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: argparse.Namespace) -> int:
    """Run or read the results, print the tables; returns the exit code."""
    check_usage(arguments)
    with checking_options():
        limit_memory(arguments.max_memory)
        config = localizer_from(arguments)
    thresholds = Thresholds(arguments.max_distance, float(np.radians(arguments.max_angle)))
    scenes = find_scenes(arguments.scenes or [])
    check_files(arguments, input_files(scenes))
    if arguments.compare:
        return compare(arguments, thresholds)
    if arguments.results:
        results = read_results([arguments.results])
        report = partial(print_error, arguments, exit_code=EXIT_BAD_INPUT)
        rows = list(match_results(scenes, results, report))
        num_failed = len(results) - len(rows)
        check_clouds(scenes, rows, arguments)
        rows = [row for row in rows if not arguments.variants or row.variant in arguments.variants]
    else:
        rows, num_failed = run_scenes(arguments, arguments.out, config, scenes, arguments.variants)
    if not rows:
        raise InputError("no query could be localized; check --scenes and --variants")
    rows = sorted(rows, key=lambda row: row.key)
    if arguments.csv:
        write_atomically(arguments.csv, tables.csv_text(rows).encode())
    if arguments.risk:
        points = tables.risk_and_coverage(rows, thresholds)
        write_atomically(arguments.risk, figure_png(risk_figure(points)))
    name = (arguments.out or arguments.results).stem
    write_report(arguments, report_of(scenes, rows, thresholds), {name: rows}, thresholds)
    return EXIT_BAD_INPUT if num_failed else 0
