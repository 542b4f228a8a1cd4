"""The experiments: the conditions that each compares, what the paper found there, and the table.

The paper's figures are of its own data (Stanford2D-3D-S, OmniScenes, MPO) on an RTX 2080 (Kim et al., ICCV
2021): they say what to expect of a trend, and compare in full only on the same data.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ...localization.settings import CoarseToFineSettings
from ...paper.settings import PaperSettings
from ..evaluation.query_result import QueryResult
from ..evaluation.tables import Table, summarize
from .transforms import SceneTransform, flipped, identity, with_count, with_fraction, with_random_rotation

Settings = CoarseToFineSettings | PaperSettings
NO_FIGURE = "-"
RUNTIMES = {10_000: "1.77 s + 0.01 s", 100_000: "1.90 s + 0.01 s", 1_000_000: "3.74 s + 0.02 s"}
COLUMNS = ("", "preset", "queries", "accuracy", "t 50 % [m]", "t of correct [m]", "R 50 % [deg]")


class Condition(NamedTuple):
    """One line of an experiment's table."""

    name: str
    settings: Settings
    transform: SceneTransform = identity
    variants: tuple[str, ...] = ()  # the queries that it is about; empty for all
    use_labels: bool = False
    paper: str = NO_FIGURE  # what the paper has in this place

    @property
    def preset(self) -> str:
        """The settings' preset."""
        return "paper" if isinstance(self.settings, PaperSettings) else "default"


ConditionsOf = Callable[[Sequence[Settings], Sequence[str]], list[Condition]]


class Experiment(NamedTuple):
    """A question, and the conditions that answer it."""

    title: str
    note: str  # what is varied, in a sentence
    conditions_of: ConditionsOf  # by the presets and the scenes' variants


def _paper_setting(setting: str, names: Mapping[Any, str]) -> ConditionsOf:
    """A condition for each value of a setting of preset paper, which has no counterpart in the default."""

    def conditions_of(presets: Sequence[Settings], variants: Sequence[str]) -> list[Condition]:
        paper = next((p for p in presets if isinstance(p, PaperSettings)), PaperSettings())
        return [Condition(name, replace(paper, **{setting: value})) for value, name in names.items()]

    return conditions_of


def _each_preset(cases: Mapping[str, dict[str, Any]]) -> ConditionsOf:
    """A condition for each case and preset; a case has fields of Condition, and `gravity` of the settings."""

    def conditions_of(presets: Sequence[Settings], variants: Sequence[str]) -> list[Condition]:
        return [
            Condition(name, replace(preset, gravity=case.get("gravity", preset.gravity)), **fields)
            for name, case in cases.items()
            for fields in [{field: value for field, value in case.items() if field != "gravity"}]
            for preset in presets
        ]

    return conditions_of


def _variants(presets: Sequence[Settings], variants: Sequence[str]) -> list[Condition]:
    found = {"handheld": 0.71, "turtlebot": 0.77, "change_handheld": 0.43, "change_turtlebot": 0.55}
    figures = {variant: f"accuracy {value} (OmniScenes)" for variant, value in found.items()}
    figures["mpo"] = "accuracy 0.45 (MPO)"
    # Splits may be tilted. The paper's preset needs one of known and unknown; the default tries both.
    tried = [replace(s, gravity="auto") if isinstance(s, CoarseToFineSettings) else s for s in presets]
    return [
        Condition(variant, settings, variants=(variant,), paper=figures.get(variant, NO_FIGURE))
        for variant in variants
        for settings in tried
    ]


GRAVITY_CASES: dict[str, dict[str, Any]] = {
    "gravity known": {"gravity": "known"},
    "gravity unknown": {"gravity": "unknown"},
    "images upside down": {"gravity": "unknown", "transform": flipped},
    "clouds turned at random": {"gravity": "unknown", "transform": with_random_rotation},
}
PERCENTS = (100, 50, 20, 10, 5, 2, 1)
LABEL_CASES: dict[str, dict[str, Any]] = {
    "RGB": {"paper": "0.03 m, 0.66 deg (Stanford2D-3D-S, all areas)"},
    "labels": {"use_labels": True, "paper": "0.01 m, 0.28 deg (Stanford2D-3D-S, all areas)"},
}
RUNTIME_CASES = {
    f"{count} points": {"transform": with_count(count), "paper": f"{seconds} (RTX 2080)"}
    for count, seconds in RUNTIMES.items()
}
EXPERIMENTS = {
    "translations": Experiment(
        "number of start positions",
        "N_t of preset paper is varied",
        _paper_setting("num_translations", {n: f"N_t = {n}" for n in (10, 25, 50, 100, 200, 400)}),
    ),
    "rotations": Experiment(
        "number of start rotations",
        "N_r of preset paper is varied",
        _paper_setting("num_rotations", {n: f"N_r = {n}" for n in (2, 4, 8, 16, 32)}),
    ),
    "initialization": Experiment(
        "how starts are chosen",
        "K2 by the loss alone, or by the loss and then histograms",
        _paper_setting("initialization", {"loss-only": "loss alone", "two-stage": "loss, then histograms"}),
    ),
    "loss": Experiment(
        "sampling against photometric loss",
        "the loss of preset paper, in search and descent",
        _paper_setting("loss", {"photometric": "photometric loss", "sampling": "sampling loss"}),
    ),
    "gravity": Experiment(
        "gravity, images upside down, clouds turned",
        "what is known of the vertical is varied",
        _each_preset(GRAVITY_CASES),
    ),
    "density": Experiment(
        "density of the cloud",
        "points are left out at random",
        _each_preset({f"{p:g} % of the points": {"transform": with_fraction(p / 100)} for p in PERCENTS}),
    ),
    "labels": Experiment(
        "semantic labels as colours",
        "what is compared: colours or labels",
        _each_preset(LABEL_CASES),
    ),
    "runtime": Experiment(
        "seconds by the number of points",
        "points are left out at random; search + refinement",
        _each_preset(RUNTIME_CASES),
    ),
    "variants": Experiment("splits of the data: changed scenes, light", "a line a split", _variants),
}


def table(title: str, found: Sequence[tuple[Condition, Sequence[QueryResult]]]) -> Table:
    """A line a condition, the paper's figure at its end."""
    columns = (*COLUMNS, "search s", "refine s", "localized", "wrong of these", "the paper")
    return Table(title, columns, tuple(_cells(condition, rows) for condition, rows in found), 2)


def _cells(condition: Condition, rows: Sequence[QueryResult]) -> tuple[str, ...]:
    summary = summarize(rows)
    errors = f"{summary.position_quartiles[1]:.4f}", f"{_median_of_correct(rows):.4f}"
    angle = f"{np.degrees(summary.rotation_quartiles[1]):.3f}"
    stages = [[row.result.seconds.get(stage, 0.0) for row in rows] for stage in ("search", "refine")]
    seconds = [f"{np.median(stage):.2f}" for stage in stages]
    counts = f"{summary.num_queries}", f"{summary.accuracy:.3f}"
    verdicts = f"{summary.num_localized}", f"{summary.num_wrong}"
    return (condition.name, condition.preset, *counts, *errors, angle, *seconds, *verdicts, condition.paper)


def _median_of_correct(rows: Sequence[QueryResult]) -> float:
    """Median position error [m] of the correct poses, NaN if there are none."""
    errors = [row.position_error for row in rows if row.is_correct()]
    return float(np.median(errors)) if errors else float("nan")
