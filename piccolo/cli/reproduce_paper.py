"""The paper's experiments on scenes with true poses: a table beside the paper's figures, and a plot."""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ..cloud.label_colors import Labels
from ..cloud.settings import CloudSettings
from ..coarse_to_fine.settings import CoarseToFineSettings
from ..errors import InputError
from ..panorama import ReadOptions
from ..paper.settings import PaperSettings
from ..pipeline import CachePolicy
from ..runtime.atomic import write_atomically
from ..runtime.threads import num_cores
from ..scenes.evaluation.row import Row
from ..scenes.evaluation.run_file import open_run
from ..scenes.evaluation.runner import Plan
from ..scenes.experiments.arms import EXPERIMENTS, Arm, Settings
from ..scenes.experiments.report import plot_png, table
from ..scenes.scene import Scene, find_scenes
from .errors import EXIT_BAD_INPUT, complain, guarded
from .progress import shown

EPILOG = """\
examples:
  python tools/make_room.py --out rooms --scenes 25 --panoramas 2 --labels
  python tools/reproduce_paper.py gravity density --scenes rooms --out results
  python tools/reproduce_paper.py labels --scenes datasets/stanford --out results --presets paper --jobs 4

experiments:
{experiments}

Writes OUT/NAME.md, OUT/NAME.png and OUT/NAME/ARM_PRESET.jsonl, whose lines tools/evaluate.py compares; the
same command takes up an experiment that was stopped. Changed clouds and images are temporary.
exit codes: 0 done, 2 wrong usage, 3 bad input (the rest is done), 4 internal error, 130 interrupted.
"""
PROGRAM = "experiments.py"
PRESETS: dict[str, Settings] = {"paper": PaperSettings(), "default": CoarseToFineSettings(gravity="known")}


def build_parser() -> argparse.ArgumentParser:
    """All options."""
    lines = [f"  {name:<15} {experiment.title}" for name, experiment in EXPERIMENTS.items()]
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog=EPILOG.format(experiments="\n".join(lines)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="+", choices=list(EXPERIMENTS), metavar="NAME", help="see below")
    parser.add_argument("--scenes", type=Path, nargs="+", required=True, metavar="FOLDER")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="made if it is not there")
    parser.add_argument("--variants", nargs="+", metavar="NAME", default=[], help="only these splits")
    text = "where both are compared (default both)"
    parser.add_argument("--presets", nargs="+", choices=list(PRESETS), default=list(PRESETS), help=text)
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default 1)")
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def file_name(arm: Arm) -> str:
    """An arm's name without what a path must not have."""
    words = f"{arm.name}_{arm.preset}".replace("%", "percent")
    return "".join(c if c.isalnum() else "_" for c in words) + ".jsonl"


def chosen_variants(arm: Arm, wanted: Sequence[str]) -> tuple[str, ...]:
    """The splits that an arm is tried on, of those wanted; empty for all."""
    if not arm.variants:
        return tuple(wanted)
    return tuple(variant for variant in arm.variants if not wanted or variant in wanted)


def changed_scenes(arm: Arm, scenes: Sequence[Scene], root: Path) -> tuple[list[Scene], int]:
    """The scenes as an arm wants them, and the number of queries of those that can't be so."""
    changed, num_failed = [], 0
    for number, scene in enumerate(scenes):
        folder = root / str(number)
        folder.mkdir()
        try:
            changed.append(arm.change(scene, folder))
        except InputError as error:
            tell(str(error))
            num_failed += len(scene.queries)
    return changed, num_failed


def run_arm(
    arm: Arm, scenes: Sequence[Scene], out: Path, arguments: argparse.Namespace
) -> tuple[list[Row], int]:
    """The rows of one arm, and how many queries could not be tried."""
    labels = Labels() if arm.use_labels else None
    reading = CloudSettings(labels=labels), ReadOptions(labels=labels)
    with tempfile.TemporaryDirectory(prefix="piccolo-") as temporary:
        changed, num_failed = changed_scenes(arm, scenes, Path(temporary))
        cache = CachePolicy(True, Path(temporary))
        plan = Plan(arm.settings, *reading, cache, max(1, num_cores() // arguments.jobs))
        run = open_run(out / file_name(arm), plan, changed, chosen_variants(arm, arguments.variants))
        rows, num_failed_later = run.finish(arguments.jobs, shown(arguments.quiet), tell)
    return rows, num_failed + num_failed_later


def tell(text: str) -> None:
    """Say what could not be tried."""
    complain(PROGRAM, False, text, EXIT_BAD_INPUT)


def run_experiment(name: str, scenes: Sequence[Scene], arguments: argparse.Namespace) -> int:
    """All arms of one experiment, its table and plot; returns how many queries could not be tried."""
    experiment = EXPERIMENTS[name]
    folder: Path = arguments.out / name
    folder.mkdir(parents=True, exist_ok=True)
    variants = sorted({query.variant for scene in scenes for query in scene.queries})
    variants = [variant for variant in variants if not arguments.variants or variant in arguments.variants]
    num_failed, found = 0, []
    for arm in experiment.arms_of([PRESETS[preset] for preset in arguments.presets], variants):
        rows, num_failed_here = run_arm(arm, scenes, folder, arguments)
        num_failed += num_failed_here
        if rows:
            found.append((arm, sorted(rows, key=lambda row: row.key)))
    if not found:
        raise InputError(f"{name}: found no query that could be tried, wanted some")
    num_scenes = len({row.scene for _, rows in found for row in rows})
    title = f"{experiment.title}: {experiment.note}; {num_scenes} scenes"
    text = table(title, found).markdown()
    print(text, flush=True)
    write_atomically(arguments.out / f"{name}.md", text.encode())
    write_atomically(arguments.out / f"{name}.png", plot_png(experiment.title, found))
    return num_failed


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = build_parser()
    arguments = parser.parse_args(argv)
    if arguments.jobs < 1:
        parser.error(f"--jobs: found {arguments.jobs}, wanted at least 1")

    def run() -> int:
        scenes = find_scenes(arguments.scenes)
        num_failed = sum([run_experiment(name, scenes, arguments) for name in arguments.names])
        return EXIT_BAD_INPUT if num_failed else 0

    return guarded(PROGRAM, arguments.debug, run)
