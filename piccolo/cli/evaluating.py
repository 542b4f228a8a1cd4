"""The queries of scenes localized, scene by scene, as localize.py localizes photos."""

import argparse
import json
import signal
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from ..batch.localizer import Localizer
from ..files.atomic import check_output
from ..files.line_file import LineFile, locked
from ..jobs.cluster import Cluster
from ..jobs.tasks import WorkerLostError
from ..jobs.threads import Workers
from ..result import UNREADABLE, Result, failure_of
from ..scan import Scan, settings_json
from ..scenes.evaluation.query_result import QueryResult, is_in_box, query_result_of
from ..scenes.evaluation.runs import check_run, check_variants, read_run
from ..scenes.scene import Query, Scene
from .errors import EXIT_BAD_INPUT, Terminated, print_error
from .executing import Interruption, connecting, count_jobs, executing, interruptible
from .progress import progress_bar


def run_scenes(
    arguments: argparse.Namespace,
    path: Path,
    config: Localizer,
    scenes: Sequence[Scene],
    variants: Sequence[str],
) -> tuple[list[QueryResult], int]:
    """Localize the queries that a run does not have yet; `config` is for any scan, no variants are all.

    Returns the run's queries of these scenes and variants, and how many failed. Raises InputError if the file
    can't be written, holds something else, or rows made with other settings.
    """
    check_variants(scenes, variants)
    check_output(path)
    settings = settings_json(config.settings, config.cloud_settings, config.read_options)
    with locked(path) as file, ExitStack() as stack:
        rows, size = read_run(path)
        check_run(path, rows, scenes, {"settings": json.loads(json.dumps(settings))})
        pairs = [(scene, query) for scene in scenes for query in scene.queries]
        keys = {(s.name, s.name_of(q)) for s, q in pairs if not variants or q.variant in variants}
        open_keys = keys - {row.key for row in rows}
        found = ((s, [q for q in s.queries if (s.name, s.name_of(q)) in open_keys]) for s in scenes)
        left = [(scene, queries) for scene, queries in found if queries]
        evaluation = Evaluation(arguments, config, file, rows)
        if left:
            file.cut(size)
            num_jobs = count_jobs(arguments, max(len(queries) for _, queries in left))
            cluster = stack.enter_context(connecting(arguments, num_jobs))
            with interruptible() as interruption:
                for scene, queries in left:
                    if not interruption.number:
                        evaluation.localize(scene, queries, cluster, interruption)
            if interruption.number:
                raise Terminated if interruption.number == signal.SIGTERM else KeyboardInterrupt
    return [row for row in evaluation.rows if row.key in keys], evaluation.num_failed


@dataclass
class Evaluation:
    """A run over scenes that is being written."""

    arguments: argparse.Namespace
    config: Localizer  # of any scan
    file: LineFile
    rows: list[QueryResult]
    num_failed: int = 0

    def localize(
        self, scene: Scene, queries: Sequence[Query], cluster: Cluster | None, interruption: Interruption
    ) -> None:
        """Localize queries of a scene, and append their lines."""
        show = progress_bar(self.arguments.quiet)
        are_inside: list[bool] = []  # the cloud's box

        def open_scan(localizer: Localizer, num_threads: int) -> Scan:
            scan = localizer.open_scan(Workers(num_threads, show))
            are_inside.extend(is_in_box(scan, query.pose) for query in queries)
            return scan

        localizer = replace(self.config, paths=(scene.cloud,))
        if has_labels := localizer.read_options.labels is not None:
            for query in queries:
                if query.labels is None:
                    self.report(f"{scene.folder}: {scene.name_of(query)} has no labels in queries.json")
            queries = [query for query in queries if query.labels]
        num_jobs = count_jobs(self.arguments, len(queries))
        with ExitStack() as stack:
            place = executing(self.arguments, localizer, num_jobs, cluster, open_scan)
            try:
                executor, localizer = stack.enter_context(place)
            except Exception as error:
                self.report(f"{scene.name}: {failure_of(error).text}", len(queries))
                return
            pictures = (query.labels if has_labels and query.labels else query.image for query in queries)
            tasks = (localizer.task(p, q.calibration) for p, q in zip(pictures, queries, strict=True))
            values = executor.values(tasks)
            pairs = interruption.each(show(iter(values), len(queries), scene.name), values.finished())
            for query, is_inside, (task, wait) in zip(queries, are_inside, pairs, strict=False):
                try:
                    result = wait().result
                except WorkerLostError as error:
                    result = localizer.lost(task, error, None).result
                self.record(scene, query, result, is_inside)

    def record(self, scene: Scene, query: Query, result: Result, is_inside: bool) -> None:
        """Append the line of a query, or say why it has none."""
        if result.error is not None and (result.status != UNREADABLE or query.is_answerable):
            self.report(result.error)
            return
        row = query_result_of(scene, query, result, None if result.error else is_inside)
        line = row.to_json()
        self.file.append(line)
        self.rows.append(QueryResult.from_json(line))  # as whoever reads the file has it

    def report(self, text: str, num_queries: int = 1) -> None:
        """Say why queries could not be localized."""
        print_error(self.arguments, text, EXIT_BAD_INPUT)
        self.num_failed += num_queries
