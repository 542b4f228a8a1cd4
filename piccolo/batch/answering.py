"""The loop of a batch: each photo is localized, and some again with the help of others, until a signal."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..api.values import Result
from ..system.jobs.cluster import Cluster
from ..system.jobs.interruption import Interruption
from ..system.jobs.processes import Here, Processes, WorkerLostError
from ..together.second_looks import LISTINGS, Change, Look, follow_cameras, revise
from .localizer import Answer, Localizer, Task

Executor = Here | Processes | Cluster
Show = Callable[[Iterable[Any]], Iterable[Any]]  # wraps an iterable to show its progress


def follow_all(results: list[Result], min_confidence: float) -> Iterator[tuple[Change, Answer]]:
    """Replace results in their list by the focal length of their camera; yield changes and answers."""
    for change in follow_cameras(results, min_confidence):
        yield change, Answer(change.after, change.after.warnings)


def count_looks(results: Sequence[Result]) -> int:
    """Return how many photos are to be localized again."""
    return sum(len(list_looks(results)) for list_looks in LISTINGS)


@dataclass(frozen=True)
class Answering:
    """The means to localize photos: in this process, in several, or in a cluster."""

    executor: Executor
    localizer: Localizer
    cloud_sha256: str | None = None  # digest of the scan, if it is known

    def answer_all(
        self, tasks: Iterator[Task], show: Show = iter, interruption: Interruption | None = None
    ) -> Iterator[Answer]:
        """Yield the answers to tasks in order; after a signal, only those that are done."""
        values = self.executor.values(tasks)
        pairs = show(values)
        for task, wait in interruption.each(pairs, values.take_finished()) if interruption else pairs:
            try:
                answer = wait()
            except WorkerLostError as error:
                answer = self.localizer.give_up(task, error, self.cloud_sha256)
            yield answer

    def look_again(
        self,
        results: list[Result],
        show: Callable[[Iterable[Any], int], Iterable[Any]],
        interruption: Interruption,
        tell: Callable[[str], object],
    ) -> Iterator[tuple[Change, Answer]]:
        """Replace results in their list by the focal length of their camera, then by looks beside others.

        Yields each change, with the answer from which it comes. `show` gets the looks and their number.
        `tell` is called with the reason if a look fails.
        """
        answered: dict[int, Answer] = {}

        def make_looks(looks: Sequence[Look]) -> Iterator[Result]:
            if interruption.number:
                return
            tasks = (self.localizer.task(Path(look.pano))._replace(look=look) for look in looks)
            answers = self.answer_all(tasks, lambda pairs: show(pairs, len(looks)), interruption)
            for look, answer in zip(looks, answers, strict=False):
                if answer.result.error is not None:
                    tell(answer.result.error)
                else:
                    answered[look.number] = answer
                yield answer.result

        for change in revise(results, make_looks, self.localizer.settings.min_confidence):
            yield change, answered.pop(change.number, Answer(change.after, change.after.warnings))
