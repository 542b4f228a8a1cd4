"""The experiments: which arms each has, and what the paper found there.

The paper's figures are of its own data (Stanford2D-3D-S, OmniScenes, MPO) on an RTX 2080 (Kim et al., ICCV
2021): they say what to expect of a trend, and compare in full only on the same data.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ...coarse_to_fine.settings import CoarseToFineSettings
from ...paper.settings import PaperSettings
from .changes import Change, as_it_is, flipped, turned_at_random, with_count, with_share

Settings = CoarseToFineSettings | PaperSettings
NO_FIGURE = "-"


@dataclass(frozen=True)
class Arm:
    """One line of an experiment's table."""

    name: str
    settings: Settings
    change: Change = as_it_is
    variants: tuple[str, ...] = ()  # the queries that it is about; empty for all
    use_labels: bool = False
    paper: str = NO_FIGURE  # what the paper has in this place

    @property
    def preset(self) -> str:
        """The settings' preset."""
        return "paper" if isinstance(self.settings, PaperSettings) else "default"


@dataclass(frozen=True)
class Experiment:
    """A question, and the arms that answer it."""

    title: str
    note: str  # what is varied, in a sentence
    arms_of: Callable[[Sequence[Settings], Sequence[str]], list[Arm]]  # of the presets, the scenes' variants


def _paper_only(presets: Sequence[Settings]) -> PaperSettings:
    """The paper's settings: what is varied has no counterpart in the default engine."""
    return next((p for p in presets if isinstance(p, PaperSettings)), PaperSettings())


def _translations(presets: Sequence[Settings], variants: Sequence[str]) -> list[Arm]:
    paper = _paper_only(presets)
    return [Arm(f"N_t = {n}", replace(paper, num_translations=n)) for n in (10, 25, 50, 100, 200, 400)]


def _rotations(presets: Sequence[Settings], variants: Sequence[str]) -> list[Arm]:
    paper = _paper_only(presets)
    return [Arm(f"N_r = {n}", replace(paper, num_rotations=n)) for n in (2, 4, 8, 16, 32)]


def _initialization(presets: Sequence[Settings], variants: Sequence[str]) -> list[Arm]:
    paper = _paper_only(presets)
    return [
        Arm("by the loss alone", replace(paper, initialization="loss-only")),
        Arm("loss, then histograms", replace(paper, initialization="two-stage")),
    ]


def _loss(presets: Sequence[Settings], variants: Sequence[str]) -> list[Arm]:
    paper = _paper_only(presets)
    return [
        Arm("photometric loss", replace(paper, loss="photometric")),
        Arm("sampling loss", replace(paper, loss="sampling")),
    ]


def _gravity(presets: Sequence[Settings], variants: Sequence[str]) -> list[Arm]:
    cases: tuple[tuple[str, bool, Change], ...] = (
        ("gravity known", True, as_it_is),
        ("gravity unknown", False, as_it_is),
        ("images upside down", False, flipped),
        ("clouds turned at random", False, turned_at_random),
    )
    return [
        Arm(name, replace(settings, gravity="known" if is_known else "unknown"), change)
        for name, is_known, change in cases
        for settings in presets
    ]


def _density(presets: Sequence[Settings], variants: Sequence[str]) -> list[Arm]:
    shares = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
    return [
        Arm(f"{100 * share:g} % of the points", settings, with_share(share))
        for share in shares
        for settings in presets
    ]


def _labels(presets: Sequence[Settings], variants: Sequence[str]) -> list[Arm]:
    figures = {
        False: "0.03 m, 0.66 deg (Stanford2D-3D-S, all areas)",
        True: "0.01 m, 0.28 deg (Stanford2D-3D-S, all areas)",
    }
    return [
        Arm("labels" if is_label else "RGB", settings, use_labels=is_label, paper=figures[is_label])
        for is_label in (False, True)
        for settings in presets
    ]


def _runtime(presets: Sequence[Settings], variants: Sequence[str]) -> list[Arm]:
    figures = {
        10_000: "1.77 s + 0.01 s (RTX 2080)",
        100_000: "1.90 s + 0.01 s (RTX 2080)",
        1_000_000: "3.74 s + 0.02 s (RTX 2080)",
    }
    return [
        Arm(f"{count} points", settings, with_count(count), paper=figure)
        for count, figure in figures.items()
        for settings in presets
    ]


def _variants(presets: Sequence[Settings], variants: Sequence[str]) -> list[Arm]:
    figures = {
        "handheld": "accuracy 0.71 (OmniScenes)",
        "turtlebot": "accuracy 0.77 (OmniScenes)",
        "change_handheld": "accuracy 0.43 (OmniScenes)",
        "change_turtlebot": "accuracy 0.55 (OmniScenes)",
        "mpo": "accuracy 0.45 (MPO)",
    }
    # Splits may be tilted. The paper's preset is told one way or the other; the engine finds out.
    tried = [replace(s, gravity="auto") if isinstance(s, CoarseToFineSettings) else s for s in presets]
    return [
        Arm(variant, settings, variants=(variant,), paper=figures.get(variant, NO_FIGURE))
        for variant in variants
        for settings in tried
    ]


EXPERIMENTS = {
    "translations": Experiment("number of start positions", "N_t of preset paper is varied", _translations),
    "rotations": Experiment("number of start rotations", "N_r of preset paper is varied", _rotations),
    "initialization": Experiment(
        "how starts are chosen", "K2 by the loss alone, or by the loss and then histograms", _initialization
    ),
    "loss": Experiment(
        "sampling against photometric loss", "the loss of preset paper, in search and descent", _loss
    ),
    "gravity": Experiment(
        "gravity, images upside down, clouds turned", "what is known of the vertical is varied", _gravity
    ),
    "density": Experiment("density of the cloud", "points are left out at random", _density),
    "labels": Experiment("semantic labels as colours", "what is compared: colours or labels", _labels),
    "runtime": Experiment(
        "seconds by the number of points", "points are left out at random; search + refinement", _runtime
    ),
    "variants": Experiment("splits of the data: changed scenes, light", "a line a split", _variants),
}  # fmt: skip
