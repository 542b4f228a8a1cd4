"""An experiment's table and picture."""

from collections.abc import Sequence

import numpy as np

from ...runtime.figure import new_figure
from ..evaluation.plots import figure_png
from ..evaluation.query_result import QueryResult
from ..evaluation.tables import Table, summarize
from .experiments import Condition

COLUMNS = ("", "preset", "queries", "accuracy", "t 50 % [m]", "t of correct [m]", "R 50 % [deg]")


def table(title: str, found: Sequence[tuple[Condition, Sequence[QueryResult]]]) -> Table:
    """A line a condition, the paper's figure at its end."""
    columns = (*COLUMNS, "search s", "refine s", "localized", "wrong of these", "the paper")
    return Table(title, columns, tuple(_cells(condition, rows) for condition, rows in found), 2)


def _cells(condition: Condition, rows: Sequence[QueryResult]) -> tuple[str, ...]:
    summary = summarize(rows)
    errors = f"{summary.position_quartiles[1]:.4f}", f"{_median_of_correct(rows):.4f}"
    angle = f"{np.degrees(summary.rotation_quartiles[1]):.3f}"
    seconds = tuple(f"{_median_seconds(rows, stage):.2f}" for stage in ("search", "refine"))
    counts = f"{summary.num_queries}", f"{summary.accuracy:.3f}"
    verdicts = f"{summary.num_localized}", f"{summary.num_wrong}"
    return (condition.name, condition.preset, *counts, *errors, angle, *seconds, *verdicts, condition.paper)


def _median_seconds(rows: Sequence[QueryResult], stage: str) -> float:
    return float(np.median([row.result.seconds.get(stage, 0.0) for row in rows]))


def _median_of_correct(rows: Sequence[QueryResult]) -> float:
    """Median position error [m] of the correct poses, NaN if there are none."""
    errors = [row.position_error for row in rows if row.is_correct()]
    return float(np.median(errors)) if errors else float("nan")


def plot_png(title: str, found: Sequence[tuple[Condition, Sequence[QueryResult]]]) -> bytes:
    """Accuracy, median error of the correct poses and seconds over the conditions, a line a preset."""
    names = list(dict.fromkeys(condition.name for condition, _ in found))
    figure = new_figure(figsize=(13, 4.4), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(1, 3)
    for preset in dict.fromkeys(condition.preset for condition, _ in found):
        own = [(names.index(condition.name), rows) for condition, rows in found if condition.preset == preset]
        summaries = [summarize(rows) for _, rows in own]
        values = (
            [100.0 * summary.accuracy for summary in summaries],
            [1000.0 * _median_of_correct(rows) for _, rows in own],
            [summary.seconds for summary in summaries],
        )
        for axes, some in zip(panels, values, strict=True):
            axes.plot([place for place, _ in own], some, "o-", label=preset)
    for axes, label in zip(panels, ("correct [%]", "median error of correct [mm]", "seconds"), strict=True):
        axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.legend()
    panels[0].set_ylim(0, 103)
    panels[2].set_ylim(bottom=0)
    return figure_png(figure)
