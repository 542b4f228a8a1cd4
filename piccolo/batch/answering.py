"""The photos of a batch are answered, and looked at again with what the others tell, until a signal."""

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
Show = Callable[[Iterable[Any]], Iterable[Any]]  # wraps what is at work


def follow_all(results: list[Result], min_confidence: float) -> Iterator[tuple[Change, Answer]]:
    """Change results in their list by what all photos of a camera say; yield each change and its answer."""
    for change in follow_cameras(results, min_confidence):
        yield change, Answer(change.after, change.after.warnings)


def count_looks(results: Sequence[Result]) -> int:
    """Return how many photos are to be looked at again."""
    return sum(len(list_looks(results)) for list_looks in LISTINGS)


@dataclass(frozen=True)
class Answering:
    """Photos are answered in this process, in several, or in a cluster."""

    executor: Executor
    localizer: Localizer
    cloud_sha256: str | None = None  # of the scan, where it is known

    def answer_all(
        self, tasks: Iterator[Task], show: Show = iter, interruption: Interruption | None = None
    ) -> Iterator[Answer]:
        """Yield the answers to tasks in order, after a signal those that are done."""
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
        """Change results in their list by what others say of their camera, and then beside others.

        Yields each change, with the answer it is by; `show` gets also how many looks there are. `tell` is
        told why a look has failed.
        """
        answered: dict[int, Answer] = {}

        def ask(looks: Sequence[Look]) -> Iterator[Result]:
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

        for change in revise(results, ask, self.localizer.settings.min_confidence):
            yield change, answered.pop(change.number, Answer(change.after, change.after.warnings))
