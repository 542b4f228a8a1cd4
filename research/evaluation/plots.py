"""Plots of an evaluation, as PNG."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np

from piccolo.optional import import_optional

from .query_result import QueryResult, Thresholds
from .tables import Point

Figure = Any  # of matplotlib, which is imported when one is drawn

POSITIONS = (1e-4, 30.0)  # of the axis [m]
ROTATIONS_DEG = (1e-3, 180.0)
SHOWN_ANGLES_DEG = (1.0, 5.0, 10.0)  # at which recall over distance is drawn


def new_figure(**options: Any) -> Figure:
    """Return an empty figure that belongs to no window, by matplotlib, whose import takes half a second."""
    return import_optional("a plot", "matplotlib.figure", "tools").Figure(**options)


def figure_png(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    file = BytesIO()
    figure.savefig(file, format="png", dpi=120)
    return file.getvalue()


def _fraction_below(axes: Any, errors: Sequence[float], label: str) -> None:
    """Draw the fraction of the errors below each value; queries without a pose never count."""
    finite = np.sort([error for error in errors if np.isfinite(error)])
    fractions = 100.0 * np.arange(1, len(finite) + 1) / max(len(errors), 1)
    last = fractions[-1] if len(fractions) else 0.0
    axes.step([1e-9, *finite, 1e9], [0.0, *fractions, last], where="post", label=label)


def errors_figure(runs: Mapping[str, Sequence[QueryResult]], thresholds: Thresholds) -> Figure:
    """Position and rotation error over the fraction of queries, and recall over thresholds, a line a run."""
    figure = new_figure(figsize=(14, 4.2), layout="constrained")
    position, rotation, recall = figure.subplots(1, 3)
    for name, rows in runs.items():
        _fraction_below(position, [row.position_error for row in rows], name)
        _fraction_below(rotation, [float(np.degrees(row.rotation_error)) for row in rows], name)
        for angle_deg in SHOWN_ANGLES_DEG:
            pairs = [(row.position_error, np.degrees(row.rotation_error)) for row in rows]
            inside = [distance if angle < angle_deg else np.inf for distance, angle in pairs]
            _fraction_below(recall, inside, f"{name}, under {angle_deg:g} deg")
    position.axvline(thresholds.max_distance, color="gray", linestyle=":")
    rotation.axvline(float(np.degrees(thresholds.max_angle)), color="gray", linestyle=":")
    recall.axvline(thresholds.max_distance, color="gray", linestyle=":")
    position.set(xlabel="position error [m]", xlim=POSITIONS)
    rotation.set(xlabel="rotation error [deg]", xlim=ROTATIONS_DEG)
    recall.set(xlabel="distance [m]", xlim=POSITIONS, title="recall")
    for axes in (position, rotation, recall):
        axes.set(xscale="log", ylim=(0, 101), ylabel="queries [%]")
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", fontsize="small")
    return figure


def risk_figure(points: Sequence[Point]) -> Figure:
    """Return the fraction that is wrong over the fraction that is accepted."""
    figure = new_figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    coverage = [100 * p.coverage for p in points]
    risk = [100 * p.risk for p in points]
    axes.step([0.0, *coverage], [risk[0], *risk], where="pre")
    for line in (0.99, 0.9, 0.5):
        inside = [p for p in points if p.confidence >= line]
        if inside:
            axes.plot(100 * inside[-1].coverage, 100 * inside[-1].risk, "o", label=f"confidence {line}")
    axes.set(xlabel="accepted [%]", ylabel="wrong of the accepted [%]")
    axes.set(xlim=(0, 100), ylim=(0, max(5.0, 1.1 * max(risk))))
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend()
    return figure
