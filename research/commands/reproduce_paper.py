"""Run the paper's experiments on scenes with true poses, and compare the results with its figures."""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from piccolo.batch.localizer import Localizer
from piccolo.cli.command import check_least, command, option
from piccolo.cli.errors import EXIT_BAD_INPUT, checking_options, print_error
from piccolo.cli.executing import check_execution
from piccolo.cli.options import add_execution_options
from piccolo.cli.outputs import check_distinct, check_folder_name
from piccolo.cloud.settings import CloudSettings
from piccolo.errors import InputError
from piccolo.files.atomic import write_atomically
from piccolo.geometry.colors import Labels
from piccolo.jobs.memory import limit_memory
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.paper.settings import PaperSettings
from piccolo.photo import Photo
from piccolo.scan_map.open_map import CachePolicy
from piccolo.scene import Scene, find_scenes, input_files

from ..evaluation.query_result import QueryResult
from ..experiments.reproduce_paper import EXPERIMENTS, Condition, Settings, table
from .evaluate import run_scenes

_EXPERIMENTS = "\n".join(f"  {name:<15} {experiment.title}" for name, experiment in EXPERIMENTS.items())
EPILOG = f"""\
examples:
  python tools/reproduce_paper.py gravity density --scenes rooms --out results
  python tools/reproduce_paper.py labels --scenes datasets/stanford --out results --presets paper --jobs 4

experiments:
{_EXPERIMENTS}

Writes the table OUT/NAME.md and the runs OUT/NAME/CONDITION_PRESET.jsonl, for tools/evaluate.py --compare.
A repeated command resumes a stopped experiment. Modified clouds and images are temporary files.
"""
PRESETS: dict[str, Settings] = {"paper": PaperSettings(), "default": CoarseToFineSettings(gravity="known")}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    names = list(EXPERIMENTS)
    parser.add_argument("names", nargs="+", choices=names, metavar="NAME", help="experiments, see below")
    option(parser, "--scenes FOLDER ...", "scenes with true poses", required=True)
    option(parser, "--out FOLDER", "folder of the tables and runs; created if missing", required=True)
    option(parser, "--variants NAME ...", "only these splits of the data", default=[])
    option(parser, "--presets", nargs="+", choices=PRESETS, default=list(PRESETS))
    add_execution_options(parser, default_jobs=1)
    parser.set_defaults(mask=None)


def file_name(condition: Condition) -> str:
    """Return the file of a condition: its name without characters that a path must not have."""
    words = f"{condition.name}_{condition.preset}".replace("%", "percent")
    return "".join(c if c.isalnum() else "_" for c in words) + ".jsonl"


def run_condition(
    condition: Condition, scenes: Sequence[Scene], out: Path, arguments: argparse.Namespace
) -> tuple[list[QueryResult], int]:
    """Return the results under one condition, and how many queries could not be localized."""
    labels = Labels() if condition.use_labels else None
    cloud_settings = CloudSettings(labels=labels)
    transformed = []
    num_failed = 0
    with tempfile.TemporaryDirectory(prefix="piccolo-") as temporary:
        for number, scene in enumerate(scenes):
            folder = Path(temporary) / str(number)
            folder.mkdir()
            try:
                transformed.append(condition.transform(scene, folder))
            except InputError as error:
                print_error(arguments, str(error), EXIT_BAD_INPUT)
                num_failed += len(scene.queries)
        cache = CachePolicy(True, Path(temporary))
        config = Localizer((), condition.settings, cloud_settings, Photo(Path()), cache)
        variants = condition.variants or arguments.variants  # those of a condition are of the wanted
        path = out / file_name(condition)
        rows, num_failed_later = run_scenes(arguments, path, config, transformed, variants)
    return rows, num_failed + num_failed_later


def run_experiment(
    name: str, scenes: Sequence[Scene], presets: Sequence[Settings], arguments: argparse.Namespace
) -> int:
    """All conditions of an experiment and its table; returns how many queries were not localized."""
    experiment = EXPERIMENTS[name]
    folder: Path = arguments.out / name
    page: Path = arguments.out / f"{name}.md"
    variants = sorted({query.variant for scene in scenes for query in scene.queries})
    variants = [variant for variant in variants if not arguments.variants or variant in arguments.variants]
    num_failed = 0
    found = []
    conditions = experiment.conditions_of(presets, variants)
    files = [page, *(folder / file_name(condition) for condition in conditions)]
    check_distinct({file.name: file for file in files}, input_files(scenes))
    folder.mkdir(parents=True, exist_ok=True)
    for condition in conditions:
        rows, num_failed_here = run_condition(condition, scenes, folder, arguments)
        num_failed += num_failed_here
        if rows:
            found.append((condition, sorted(rows, key=lambda row: row.key)))
    if not found:
        raise InputError(f"{name}: no query could be localized; check --scenes and --variants")
    num_scenes = len({row.scene for _, rows in found for row in rows})
    title = f"{experiment.title}: {experiment.note}; {num_scenes} scenes"
    text = table(title, found).markdown()
    print(text, flush=True)
    write_atomically(page, text.encode())
    return num_failed


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: argparse.Namespace) -> int:
    """Run the experiments one by one; returns the exit code."""
    check_least(arguments, jobs=1, threads=1)
    check_folder_name("--out", arguments.out)
    with checking_options():
        check_execution(arguments)
        limit_memory(arguments.max_memory)
    presets = [PRESETS[name] for name in arguments.presets]
    scenes = find_scenes(arguments.scenes)
    failed = [run_experiment(name, scenes, presets, arguments) for name in arguments.names]
    return EXIT_BAD_INPUT if any(failed) else 0
