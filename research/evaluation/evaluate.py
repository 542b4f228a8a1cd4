"""Localize the panoramas of scenes with true poses, and measure the errors of the poses."""

import json
import signal
from argparse import ArgumentParser
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from piccolo.api.photo_reader import Settings, describe_failure, settings_json
from piccolo.api.result_files import check_scan, read_results
from piccolo.api.scan import Scan
from piccolo.batch.answering import Answering
from piccolo.batch.localizer import Localizer
from piccolo.cli import execution, options, settings_given as cli_settings
from piccolo.cli.command import (
    EXIT_BAD_INPUT,
    Arguments,
    Terminated,
    UsageError,
    check_outputs,
    check_suffix,
    checking_options,
    command,
    option,
)
from piccolo.judge.result import UNREADABLE
from piccolo.problem.accuracy import PAPER_ACCURACY
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.scan_map.open_map import scan_sha256_of
from piccolo.system.errors import InputError
from piccolo.system.files.atomic import check_output, is_stream, write_atomically
from piccolo.system.files.line_file import open_locked
from piccolo.system.jobs.cluster import Cluster
from piccolo.system.jobs.interruption import Interruption, interruptible
from piccolo.system.jobs.memory import limit_memory
from piccolo.system.jobs.threads import Workers

from ..scene import Query, Scene, find_scenes, input_files
from . import query_result, tables
from .query_result import QueryResult, Thresholds

EPILOG = """\
examples:
  python tools/evaluate.py --scenes datasets/stanford --out run.jsonl --jobs 4
  python tools/evaluate.py --scenes room --results poses.jsonl
  python tools/evaluate.py --compare paper.jsonl run.jsonl

Scenes are folders with a queries.json, a cloud and images, anywhere below --scenes (research/DATASETS.md).
--out localizes the queries that the run lacks, and appends a line for each: repeat the command to resume a
stopped run. --results are lines of localize.py instead; each belongs to the query with the same path, or else
with the same file name. Tables are Markdown on stdout (on stderr if one of the files is stdout).
For walks (make_room.py --walk) there is a table with a line per walk, and one of the frames that were
searched alone, by themselves and with the others. A query with "answerable": false is correct if it is not
localized.
Errors of a path as evo defines them: tools/export_poses.py --format tum --timestamps walk, then evo_ape.
Queries that can't be read and --results without a query are named on stderr; the others are still evaluated,
and the exit code is 3.
"""


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    group = parser.add_argument_group("input and output")
    option(group, "--scenes FOLDER ...", "scenes with true poses")
    option(group, "--variants NAME ...", "only these splits of the data", default=[])
    kind = group.add_mutually_exclusive_group(required=True)
    option(kind, "--out JSONL", "file of the run, which is begun or resumed")
    option(kind, "--results JSONL", "evaluate these results of localize.py instead of running it")
    option(kind, "--compare JSONL", "compare two runs", nargs=2)
    option(group, "--force", "also take --results of other clouds than the scene's")
    option(group, "--cache FOLDER", options.CACHE_TEXT)
    group = parser.add_argument_group("tables and plots")
    text = "error below which a pose is correct (default: that of --accuracy)"
    option(group, "--max-distance M", f"position {text}")
    option(group, "--max-angle DEG", f"rotation {text}")
    option(group, "--csv FILE", "write a line per query; - is stdout, also for the other files")
    option(group, "--markdown FILE", "write the tables to this file too")
    option(group, "--errors PNG", "plot: fraction of queries below each error, and recall over thresholds")
    option(group, "--risk PNG", "plot: fraction wrong over fraction accepted, for falling minimum confidence")
    options.add_cloud_reading_options(parser.add_argument_group("clouds"))
    options.add_panorama_reading_options(parser.add_argument_group("panoramas"))
    options.add_method_options(parser)
    options.add_execution_options(parser, default_jobs=1)


def check_usage(arguments: Arguments) -> None:
    """Refuse options that do not go together, and values that are wrong whatever the files hold."""
    if (arguments.scenes is None) == (arguments.compare is None):
        raise UsageError("--scenes: needed with --out and --results, not with --compare")
    if arguments.compare and (arguments.csv or arguments.risk):
        raise UsageError("--csv, --risk: not with --compare, they show one run")
    limits = arguments.max_distance, arguments.max_angle
    if not all(0.0 < limit < np.inf for limit in limits if limit is not None):
        raise UsageError("--max-distance, --max-angle: wanted numbers above 0")
    arguments.check_least(jobs=1, threads=1)
    execution.check_execution(arguments)
    for option_ in ("errors", "risk"):
        check_suffix(f"--{option_}", getattr(arguments, option_), (".png",))
    if arguments.out and is_stream(arguments.out):
        raise UsageError(f"--out {arguments.out}: a run is read again to be resumed, wanted a file")


def thresholds_from(arguments: Arguments, settings: Settings) -> Thresholds:
    """Return the errors below which poses are correct: by default those that a localized pose may have."""
    wanted = settings.accuracy if isinstance(settings, CoarseToFineSettings) else PAPER_ACCURACY
    metres = wanted.metres if arguments.max_distance is None else arguments.max_distance
    degrees = wanted.degrees if arguments.max_angle is None else arguments.max_angle
    return Thresholds(metres, float(np.radians(degrees)))


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
    if walks := tables.group_walks(scenes, rows):
        found += [tables.walk_table(walks, thresholds), tables.alone_table(walks, thresholds)]
    return "\n".join(table.markdown() for table in found)


def write_report(
    arguments: Arguments, text: str, runs: dict[str, list[QueryResult]], thresholds: Thresholds
) -> None:
    """Print the tables of one run or two, and write them and the plot of their errors if asked for."""
    if arguments.markdown:
        write_atomically(arguments.markdown, text.encode())
    if arguments.errors:
        write_atomically(arguments.errors, tables.figure_png(tables.errors_figure(runs, thresholds)))
    arguments.report(outputs_of(arguments), text)


def compare(arguments: Arguments, thresholds: Thresholds) -> int:
    """Print two runs side by side."""
    runs = [query_result.read_run(path)[0] for path in arguments.compare]
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


def outputs_of(arguments: Arguments) -> dict[str, Path | None]:
    """Return the files beside a run, by option."""
    return {f"--{name}": getattr(arguments, name) for name in ("csv", "markdown", "errors", "risk")}


def check_files(arguments: Arguments, inputs: list[Path]) -> None:
    """Refuse outputs that would replace an input, a run or each other."""
    given = arguments.results, arguments.mask, arguments.camera, arguments.rig
    more = filter(None, (*given, *(arguments.compare or ())))
    check_outputs({"--out": arguments.out, **outputs_of(arguments)}, [*inputs, *more])


def check_clouds(scenes: Sequence[Scene], rows: Sequence[QueryResult], arguments: Arguments) -> None:
    """Refuse results of other content than the scenes' clouds have, or with --force say so."""
    for scene in scenes:
        results = [row.result for row in rows if row.scene == scene.name and row.result.source.cloud_sha256]
        if results and scene.cloud.is_file():
            digest = scan_sha256_of([scene.cloud], cli_settings.cache_from(arguments))
            if note := check_scan(results, digest, str(scene.cloud), arguments.force):
                arguments.note(f"warning: {note}")


def run_scenes(
    arguments: Arguments, path: Path, config: Localizer, scenes: Sequence[Scene], variants: Sequence[str]
) -> tuple[list[QueryResult], int]:
    """Localize the queries that a run does not have yet; `config` is for any scan, no variants are all.

    Returns the run's queries of these scenes and variants, and how many failed. Raises InputError if the file
    can't be written, holds something else, or rows made with other settings.
    """
    query_result.check_variants(scenes, variants)
    check_output(path)
    # of all rows, without the cameras of queries.json
    settings = settings_json(config.settings, config.cloud_settings, config.photo)
    with open_locked(path) as file:
        rows, size = query_result.read_run(path)

        def keep(row: QueryResult) -> None:
            line = replace(row, result=replace(row.result, settings=settings)).to_json()
            file.append(line)
            rows.append(QueryResult.from_json(line))  # as whoever reads the file has it

        query_result.check_run(path, rows, scenes, {"settings": json.loads(json.dumps(settings))})
        pairs = [(scene, query) for scene in scenes for query in scene.queries]
        keys = {(s.name, s.name_of(q)) for s, q in pairs if not variants or q.variant in variants}
        open_keys = keys - {row.key for row in rows}
        found = ((s, [q for q in s.queries if (s.name, s.name_of(q)) in open_keys]) for s in scenes)
        if left := [(scene, queries) for scene, queries in found if queries]:
            file.cut(size)
            with (
                execution.connecting(arguments) as cluster,
                interruptible() as interruption,
            ):
                for scene, queries in left:
                    if not interruption.number:
                        localize_queries(arguments, config, scene, queries, cluster, interruption, keep)
            if interruption.number:
                raise Terminated if interruption.number == signal.SIGTERM else KeyboardInterrupt
    own = [row for row in rows if row.key in keys]
    return own, len(keys) - len(own)


def localize_queries(
    arguments: Arguments,
    config: Localizer,
    scene: Scene,
    queries: Sequence[Query],
    cluster: Cluster | None,
    interruption: Interruption,
    keep: Callable[[QueryResult], None],
) -> None:
    """Localize queries of a scene until a signal; keep each result as it comes, or say why there is none."""
    show = arguments.progress()
    are_inside: list[bool] = []  # the cloud's box

    def open_scan(localizer: Localizer, num_threads: int) -> Scan:
        scan = localizer.open_scan(Workers(num_threads, show))
        are_inside.extend(query_result.is_in_box(scan, query.pose) for query in queries)
        return scan

    if cluster:
        cluster.forget()  # a worker may not have room for the last scene's map and this one's
    localizer = replace(config, paths=(scene.cloud,))
    with ExitStack() as stack:
        num_jobs = execution.count_jobs(arguments, len(queries))
        place = execution.executing(arguments, localizer, num_jobs, cluster, open_scan)
        try:
            executor, localizer = stack.enter_context(place)
        except Exception as error:
            arguments.error(f"{scene.name}: {describe_failure(error)}")
            return
        tasks = (localizer.task(q.image, q.calibration) for q in queries)

        def shown(values: Iterable[Any]) -> Iterator[Any]:
            return show(iter(values), len(queries), scene.name)

        answers = Answering(executor, localizer).answer_all(tasks, shown, interruption)
        for query, is_inside, (result, *_) in zip(queries, are_inside, answers, strict=False):
            if result.error is None or (result.status == UNREADABLE and not query.is_answerable):
                in_box = None if result.error else is_inside
                keep(query_result.make_query_result(scene, query, result, in_box))
            else:
                arguments.error(result.error)


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Run or read the results, print the tables; returns the exit code."""
    check_usage(arguments)
    with checking_options():
        limit_memory(arguments.max_memory)
        config = cli_settings.localizer_from(arguments)
    thresholds = thresholds_from(arguments, config.settings)
    scenes = find_scenes(arguments.scenes or [])
    check_files(arguments, input_files(scenes))
    if arguments.compare:
        return compare(arguments, thresholds)
    if arguments.results:
        results = read_results([arguments.results])
        rows = list(query_result.match_results(scenes, results, arguments.error))
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
        write_atomically(arguments.risk, tables.figure_png(tables.risk_figure(points)))
    name = (arguments.out or arguments.results).stem
    write_report(arguments, report_of(scenes, rows, thresholds), {name: rows}, thresholds)
    return EXIT_BAD_INPUT if num_failed else 0
