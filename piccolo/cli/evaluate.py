"""Localize the panoramas of scenes with true poses, and tell how good the poses are."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..pipeline import CachePolicy
from ..result import Result
from ..runtime.atomic import check_output, write_atomically
from ..runtime.threads import num_cores
from ..scenes.evaluation import pictures, tables
from ..scenes.evaluation.compare import changes, pair_up, side_by_side
from ..scenes.evaluation.row import Row, match_results
from ..scenes.evaluation.run_file import inputs_of, open_run, read_rows
from ..scenes.evaluation.runner import Plan
from ..scenes.evaluation.statistics import Limits, risk_and_coverage
from ..scenes.scene import Scene, find_scenes
from .errors import EXIT_BAD_INPUT, complain, guarded
from .options import (
    add_cloud_reading_options,
    add_method_options,
    add_panorama_reading_options,
    cloud_settings_from,
    parse,
    read_options_from,
    settings_from,
)
from .progress import shown

EPILOG = """\
examples:
  python tools/evaluate.py --scenes datasets/stanford --out run.jsonl --jobs 4
  python tools/evaluate.py --scenes datasets/stanford --out paper.jsonl --preset paper --errors paper.png
  python tools/evaluate.py --scenes room --results poses.jsonl
  python tools/evaluate.py --compare paper.jsonl run.jsonl

Scenes are folders with a queries.json, a cloud and images, at any depth below --scenes (docs/DATASETS.md).
--out runs the queries that it does not have yet, and appends a line for each as it comes: give the same
command again to take up a run that was stopped. --results are lines of localize.py instead; each belongs to
the query of the same path, or else of the same file name. Tables are Markdown, on stdout.
exit codes: 0 done, 2 wrong usage, 3 bad input (the rest of a run is done), 4 internal error, 130 interrupted.
"""
PROGRAM = "evaluate.py"


def build_parser() -> argparse.ArgumentParser:
    """All options."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    source = parser.add_argument_group("what")
    source.add_argument("--scenes", type=Path, nargs="+", metavar="FOLDER", help="scenes with true poses")
    source.add_argument("--variants", nargs="+", metavar="NAME", default=[], help="only these splits")
    kind = source.add_mutually_exclusive_group(required=True)
    kind.add_argument("--out", type=Path, metavar="JSONL", help="run, or go on with this run")
    kind.add_argument("--results", type=Path, metavar="JSONL", help="results of localize.py; nothing is run")
    kind.add_argument("--compare", type=Path, nargs=2, metavar="JSONL", help="two runs, side by side")
    text = "processes; each with its share of the cores (default 1)"
    source.add_argument("--jobs", type=int, default=1, metavar="N", help=text)
    source.add_argument("--cache", type=Path, metavar="FOLDER", help="of prepared maps (default the user's)")
    told = parser.add_argument_group("tables and pictures")
    told.add_argument("--max-distance", type=float, default=0.1, metavar="M", help="correct is under (0.1)")
    told.add_argument("--max-angle", type=float, default=5.0, metavar="DEG", help="and under (5)")
    told.add_argument("--csv", type=Path, metavar="FILE", help="a line a query")
    told.add_argument("--markdown", type=Path, metavar="FILE", help="the tables, here too")
    text = "picture: share of queries under each error, and recall over thresholds"
    told.add_argument("--errors", type=Path, metavar="PNG", help=text)
    text = "picture: share that is wrong against share that is accepted, as the confidence asked for falls"
    told.add_argument("--risk", type=Path, metavar="PNG", help=text)
    add_cloud_reading_options(parser.add_argument_group("clouds"))
    add_panorama_reading_options(parser.add_argument_group("panoramas"))
    add_method_options(parser)
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def plan_of(arguments: argparse.Namespace) -> Plan:
    """How the options want queries localized."""
    num_threads = max(1, num_cores() // arguments.jobs)
    reading = cloud_settings_from(arguments), read_options_from(arguments)
    return Plan(settings_from(arguments), *reading, CachePolicy(True, arguments.cache), num_threads)


def read_results(path: Path, scenes: Sequence[Scene]) -> list[Row]:
    """The rows of a file of localize.py."""
    results = []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        try:
            results += [Result.from_json(line.decode())] if line.strip() else []
        except (InputError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: line {number}: {error}") from error
    rows = list(match_results(scenes, results))
    if not rows:
        raise InputError(f"{path}: found no result, wanted JSON lines of localize.py")
    return rows


def say(text: str) -> None:
    """Tell what could not be tried."""
    complain(PROGRAM, False, text, EXIT_BAD_INPUT)


def report(rows: Sequence[Row], limits: Limits) -> list[tables.Table]:
    """All tables of one run."""
    inside = [row for row in rows if row.is_in_box]
    boxes = [row for row in rows if row.is_in_box is not None]
    told = [tables.per_query(rows), tables.summary_table(rows, limits, f"all {len(rows)} queries")]
    if boxes:
        num_outside = len(boxes) - len(inside)
        title = f"without the {num_outside} queries taken outside the cloud's bounding box"
        told += [tables.summary_table(inside, limits, title)] if num_outside and inside else []
    told.append(tables.threshold_table(rows, limits))
    told.append(tables.risk_table(risk_and_coverage(rows, limits)))
    return told


def tell(arguments: argparse.Namespace, rows: Sequence[Row], limits: Limits) -> None:
    """Print the tables of one run, and write what else is asked for."""
    rows = sorted(rows, key=lambda row: row.key)
    text = "\n".join(table.markdown() for table in report(rows, limits))
    name = (arguments.out or arguments.results).stem
    if arguments.csv:
        write_atomically(arguments.csv, tables.csv_text(rows).encode())
    if arguments.markdown:
        write_atomically(arguments.markdown, text.encode())
    if arguments.errors:
        write_atomically(arguments.errors, pictures.errors_png({name: rows}, limits))
    if arguments.risk:
        write_atomically(arguments.risk, pictures.risk_png(risk_and_coverage(rows, limits)))
    print(text, end="")


def compare(arguments: argparse.Namespace, limits: Limits) -> int:
    """Print two runs side by side."""
    runs = [read_rows(path)[0] for path in arguments.compare]
    if arguments.variants:
        runs = [[row for row in rows if row.variant in arguments.variants] for rows in runs]
    pairs = pair_up(*runs)
    first, second = names = tuple(str(path) for path in arguments.compare)
    if not pairs:
        raise InputError(f"{first}, {second}: found no query that both have, wanted runs of the same scenes")
    text = side_by_side(pairs, (first, second), limits).markdown()
    for path, rows in zip(names, runs, strict=True):
        text += f"\nonly in {path}: {len(rows) - len(pairs)} queries"
    text += f"\n\n{changes(pairs, limits).markdown()}"
    if arguments.markdown:
        write_atomically(arguments.markdown, text.encode())
    if arguments.errors:
        both = {first: [p.first for p in pairs], second: [p.second for p in pairs]}
        write_atomically(arguments.errors, pictures.errors_png(both, limits))
    print(text, end="")
    return 0


def evaluate(arguments: argparse.Namespace, plan: Plan) -> int:
    """Do what is asked; returns the exit code."""
    limits = Limits(arguments.max_distance, float(np.radians(arguments.max_angle)))
    scenes = find_scenes(arguments.scenes or [])
    outputs = [p for p in (arguments.csv, arguments.markdown, arguments.errors, arguments.risk) if p]
    runs = [path for path in (arguments.out, arguments.results, *(arguments.compare or ())) if path]
    for output in outputs:
        check_output(output, [*inputs_of(scenes), *runs])
        if outputs.count(output) > 1 or output == arguments.out:
            raise InputError(f"{output}: found the name of two outputs, wanted one each")
    if arguments.compare:
        return compare(arguments, limits)
    num_failed = 0
    if arguments.results:
        rows = read_results(arguments.results, scenes)
    else:
        run = open_run(arguments.out, plan, scenes, arguments.variants)
        rows, num_failed = run.finish(arguments.jobs, shown(arguments.quiet), say)
    if arguments.variants:
        rows = [row for row in rows if row.variant in arguments.variants]
    if not rows:
        raise InputError("--scenes, --variants: found no query that could be tried, wanted some")
    tell(arguments, rows, limits)
    return EXIT_BAD_INPUT if num_failed else 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = build_parser()
    arguments = parse(parser, argv)
    if (arguments.scenes is None) == (arguments.compare is None):
        parser.error("--scenes goes with --out or --results; --compare stands alone")
    if arguments.compare and (arguments.csv or arguments.risk):
        parser.error("--csv, --risk: of one run, wanted without --compare")
    if not (0.0 < arguments.max_distance < np.inf and 0.0 < arguments.max_angle < np.inf):
        parser.error("--max-distance, --max-angle: wanted numbers above 0")
    if arguments.jobs < 1:
        parser.error(f"--jobs: found {arguments.jobs}, wanted at least 1")
    try:
        plan = plan_of(arguments)
    except InputError as error:
        parser.error(str(error))
    return guarded(PROGRAM, arguments.debug, lambda: evaluate(arguments, plan))
