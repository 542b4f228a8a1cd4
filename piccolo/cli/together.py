"""localize.py with photos that help each other: a bundle, a colouring or a walk.

Results are written when all are known. Until then the steps of the job are kept beside them.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from ..batch.results_file import WAYS, Records, write_results
from ..files.atomic import is_stream
from ..files.line_file import Journal, keeping_steps
from ..jobs.threads import Stopwatch
from ..panorama.photo import sha256_of
from ..photo import Photo
from ..result import FAILED, Result, read_results
from .errors import print_error, print_note
from .executing import EXIT_SOME_NOT, Interruption, choose_exit_code


class Report(NamedTuple):
    """The end of a job."""

    words: str  # on all results
    is_whole: bool = True  # False if what was asked for beside the results is not written


class Job(NamedTuple):
    """Photos to be localized together."""

    what: str  # the photos, in words
    photos: Mapping[str, Photo]  # by their names in the results
    fields: Callable[[Path], Mapping[str, Any]]  # of a photo's line, that say how it was made
    run: Callable[[Journal], list[Result] | Interruption]
    report: Callable[[Sequence[Result]], Report]  # says what was found, and writes what else was asked for
    output: Path | None = None  # that is written beside the results


def run_together(arguments: argparse.Namespace, job: Job) -> int:
    """Do a job, or what an earlier run has left of it; write and print the results, return the exit code."""
    out = arguments.out
    path = steps_file(out)
    watch = Stopwatch()
    if path and not arguments.overwrite and is_finished(out, job):
        results = read_results([out])
        if job.output is None or job.output.exists():
            print_note(arguments, f"{out}: nothing is left to do")
            return choose_exit_code({result.status for result in results})
    else:
        digest = sha256(json.dumps([job.fields(Path(name)) for name in job.photos]).encode()).hexdigest()
        key = {"photos": job.what, "sha256": digest}
        with watch.stage("all"), keeping_steps(path, key, WAYS, arguments.overwrite) as journal:
            found = job.run(journal)
        if isinstance(found, Interruption):
            return found.stop(arguments, f"some of {len(job.photos)} {job.what}", path is not None)
        results = found
        write_results(out, results)
        if path and not any(result.status == FAILED for result in results):
            path.unlink(missing_ok=True)
    report = job.report(results)
    counts = Counter(result.status for result in results)
    words = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.items())
    note = f"{len(results)} {job.what} in {watch.seconds.get('all', 0.0):.0f} s: {words}{report.words}"
    code = choose_exit_code(counts)
    if not report.is_whole:
        return print_error(arguments, note, code or EXIT_SOME_NOT)
    print_note(arguments, note)
    return code


def steps_file(out: Path | None) -> Path | None:
    """Return where the steps of a job are kept until its results are whole; None for a stream."""
    return None if out is None or is_stream(out) else out.with_name(f"{out.name}.steps")


def is_finished(out: Path, job: Job) -> bool:
    """Return True if an earlier run of a job has left all results, none of a photo that failed or is another.

    Raises InputError for results of something else.
    """
    records = Records(out)
    records.read(job.fields, job.photos)
    paths = {name: (Path(str(photo.picture)), photo.instant) for name, photo in job.photos.items()}
    return not list(records.remaining(paths, lambda name: sha256_of(*paths[name]))) and records.is_in_order
