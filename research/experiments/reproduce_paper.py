"""Run the paper's experiments on scenes with true poses, and compare the results with its figures.

The paper's figures are of its own data (Stanford2D-3D-S, OmniScenes, MPO) on an RTX 2080 (Kim et al., ICCV
2021): they say what to expect of a trend, and compare in full only on the same data.
"""

import tempfile
from argparse import ArgumentParser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import cv2
import numpy as np

from piccolo import CoarseToFineSettings, InputError, PaperSettings, Photo
from piccolo.batch.localizer import Localizer
from piccolo.cli.command import (
    EXIT_BAD_INPUT,
    Arguments,
    check_distinct,
    check_folder_name,
    checking_options,
    command,
    option,
)
from piccolo.cli.execution import check_execution
from piccolo.cli.options import add_execution_options
from piccolo.cloud.cloud_settings import BY_FILE, IN_COLORS
from piccolo.cloud.stream import open_cloud
from piccolo.cloud.writers import vertex_rows, writing_ply
from piccolo.geometry.pose import Pose, move, rotation_from_quaternion_wxyz, transform_points
from piccolo.photo.panorama import read_panorama
from piccolo.scan_map.open_map import CachePolicy
from piccolo.system.arrays import Array, Bytes, Mask
from piccolo.system.files.atomic import write_atomically
from piccolo.system.jobs.memory import limit_memory

from ..evaluation.evaluate import run_scenes
from ..evaluation.query_result import QueryResult
from ..evaluation.tables import statistics, table_of
from ..scene import CLOUD_NAME, Query, Scene, find_scenes, input_files
from ..synthetic.world import UPSIDE_DOWN
from .labels import label_colors, read_labelled_points, read_labels
from .photometric import PhotometricSettings

# A transformed copy of a scene; the folder, which is there, is for its files alone.
SceneTransform = Callable[[Scene, Path], Scene]


def thin(scene: Scene, folder: Path, fraction: float = 1.0, num_points: int | None = None) -> Scene:
    """Return a number or a fraction of the points, drawn at random; InputError where there are fewer."""
    cloud = open_cloud([scene.cloud], IN_COLORS).read()
    count = num_points or max(1, round(fraction * len(cloud.points)))
    if count > len(cloud.points):
        raise InputError(f"{scene.cloud}: found {len(cloud.points)} points, wanted at least {count}")
    chosen = np.sort(_rng(scene).choice(len(cloud.points), count, replace=False))
    points = cloud.points[chosen].astype(np.float64) + cloud.origin_world
    return replace(scene, cloud=_write_cloud(folder, points, cloud.colors[chosen]))


def with_random_rotation(scene: Scene, folder: Path) -> Scene:
    """Return the cloud turned by a rotation drawn from all of SO(3), the true poses with it."""
    cloud = open_cloud([scene.cloud], IN_COLORS).read()
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion_wxyz(_rng(scene).normal(size=4))
    points = transform_points(cloud.points.astype(np.float64) + cloud.origin_world, T)
    queries = tuple(replace(query, pose=move(query.pose, T, 1.0)) for query in scene.queries)
    return replace(scene, cloud=_write_cloud(folder, points, cloud.colors), queries=queries)


def _write_cloud(folder: Path, points: Array, colors: Bytes) -> Path:
    path = folder / CLOUD_NAME
    with writing_ply(path) as writer:
        writer.add(vertex_rows(points, colors))
    return path


def flip(scene: Scene, folder: Path) -> Scene:
    """Return every picture as if the camera was upside down: turned by half a turn about the view axis."""

    def flip_one(query: Query) -> tuple[Bytes, Mask, Pose]:
        panorama = read_panorama(query.image)
        pose = Pose(UPSIDE_DOWN @ query.pose.R_cam_from_world, query.pose.center_world)
        return panorama.rgb[::-1, ::-1], panorama.is_valid[::-1, ::-1], pose

    return _with_pictures(scene, folder, flip_one)


def show_labels(scene: Scene, folder: Path) -> Scene:
    """Return the scene with labels in place of colours, in the cloud and in all pictures.

    Each label has a colour of its own, which makes the method compare labels. The picture's pixels at the
    poles are transparent, as no disc of a tripod is looked for there: a floor of one label looks like one.
    """

    def show_one(query: Query) -> tuple[Bytes, Mask, Pose]:
        if query.labels is None:
            raise InputError(f"{scene.folder}: {scene.name_of(query)} has no labels in queries.json")
        rgb = label_colors(read_labels(query.labels))
        is_valid = np.ones(rgb.shape[:2], np.bool_)
        is_valid[[0, -1], 0] = False
        return rgb, is_valid, query.pose

    points, labels = read_labelled_points(scene.cloud)
    labelled = _with_pictures(scene, folder, show_one)
    return replace(labelled, cloud=_write_cloud(folder, points, label_colors(labels)))


def _with_pictures(scene: Scene, folder: Path, change: Callable[[Query], tuple[Bytes, Mask, Pose]]) -> Scene:
    """Return the scene with other pictures, of which `change` gives RGB, what counts, and the pose.

    They are PNG under the scene's own names, so that results of both can be compared by name.
    """
    names = [scene.name_of(query) for query in scene.queries]
    depth = max(Path(name).parts.count("..") for name in names) if names else 0
    inner = folder.joinpath(*["in"] * depth)  # so deep that no name leads out of the folder
    inner.mkdir(parents=True, exist_ok=True)
    queries = []
    for name, query in zip(names, scene.queries, strict=True):
        image = inner / name
        image.parent.mkdir(parents=True, exist_ok=True)
        rgb, is_valid, pose = change(query)
        rgba = np.dstack([rgb, np.where(is_valid, 255, 0).astype(np.uint8)])  # transparent: shows nothing
        write_atomically(image, bytes(cv2.imencode(".png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))[1]))
        queries.append(Query(image, query.variant, pose))
    return Scene(scene.name, inner, scene.cloud, tuple(queries))


def _rng(scene: Scene) -> np.random.Generator:
    """Return a generator seeded by the scene's name: the same draw whatever else is run."""
    return np.random.default_rng([crc32(scene.name.encode()), len(scene.queries)])


Settings = CoarseToFineSettings | PaperSettings


class Condition(NamedTuple):
    """One line of an experiment's table."""

    name: str
    settings: Settings
    transform: SceneTransform | None = None
    variants: tuple[str, ...] = ()  # the queries that it is about; empty for all
    paper: str = "-"  # what the paper has in this place

    @property
    def preset(self) -> str:
        """The settings' preset."""
        return "paper" if isinstance(self.settings, PaperSettings) else "default"


class Experiment(NamedTuple):
    """A question, and the conditions that answer it."""

    title: str
    note: str  # what is varied, in a sentence
    # by name: fields of Condition and of the settings, and `kind`, another class of these; None: splits
    cases: Mapping[str, Mapping[str, Any]] | None
    is_of_paper: bool = False  # about what only that preset has


def conditions_of(
    experiment: Experiment, presets: Sequence[Settings], variants: Sequence[str]
) -> list[Condition]:
    """Return a condition for each case and each preset; the cases of splits are the scenes' variants."""
    cases = experiment.cases
    if cases is None:
        cases = {v: {"variants": (v,), "paper": OF_SPLITS.get(v, "-")} for v in variants}
        # They may be tilted. The paper's preset needs one of known and unknown; the default tries both.
        presets = [replace(p, gravity="auto") if isinstance(p, CoarseToFineSettings) else p for p in presets]
    if experiment.is_of_paper:
        presets = [p for p in presets if isinstance(p, PaperSettings)] or [PaperSettings()]
    found = []
    for name, case in cases.items():
        own = {field: value for field, value in case.items() if field in Condition._fields}
        settings = {field: value for field, value in case.items() if field not in (*own, "kind")}
        for preset in presets:
            base = case["kind"](**vars(preset)) if "kind" in case else preset
            found.append(Condition(name, replace(base, **settings), **own))
    return found


OF_SPLITS = {
    "handheld": "accuracy 0.71 (OmniScenes)",
    "turtlebot": "accuracy 0.77 (OmniScenes)",
    "change_handheld": "accuracy 0.43 (OmniScenes)",
    "change_turtlebot": "accuracy 0.55 (OmniScenes)",
    "mpo": "accuracy 0.45 (MPO)",
}
RUNTIMES = {10_000: "1.77 s + 0.01 s", 100_000: "1.90 s + 0.01 s", 1_000_000: "3.74 s + 0.02 s"}
EXPERIMENTS = {
    "translations": Experiment(
        "number of start positions",
        "N_t of preset paper is varied",
        {f"N_t = {n}": {"num_translations": n} for n in (10, 25, 50, 100, 200, 400)},
        is_of_paper=True,
    ),
    "rotations": Experiment(
        "number of start rotations",
        "N_r of preset paper is varied",
        {f"N_r = {n}": {"num_rotations": n} for n in (2, 4, 8, 16, 32)},
        is_of_paper=True,
    ),
    "initialization": Experiment(
        "choice of the start poses",
        "K2 by the loss alone, or by the loss and then histograms",
        {
            "loss alone": {"initialization": "loss-only"},
            "loss, then histograms": {"initialization": "two-stage"},
        },
        is_of_paper=True,
    ),
    "loss": Experiment(
        "sampling against photometric loss",
        "the loss of preset paper, in search and descent",
        {"photometric loss": {"kind": PhotometricSettings}, "sampling loss": {}},
        is_of_paper=True,
    ),
    "gravity": Experiment(
        "gravity, images upside down, clouds rotated",
        "what is known of the vertical is varied",
        {
            "gravity known": {"gravity": "known"},
            "gravity unknown": {"gravity": "unknown"},
            "images upside down": {"gravity": "unknown", "transform": flip},
            "clouds turned at random": {"gravity": "unknown", "transform": with_random_rotation},
        },
    ),
    "density": Experiment(
        "density of the cloud",
        "points are left out at random",
        {
            f"{percent} % of the points": {"transform": partial(thin, fraction=percent / 100)}
            for percent in (100, 50, 20, 10, 5, 2, 1)
        },
    ),
    "labels": Experiment(
        "semantic labels as colours",
        "what is compared: colours or labels",
        {
            "RGB": {"paper": "0.03 m, 0.66 deg (Stanford2D-3D-S, all areas)"},
            "labels": {"transform": show_labels, "paper": "0.01 m, 0.28 deg (Stanford2D-3D-S, all areas)"},
        },
    ),
    "runtime": Experiment(
        "run time over the number of points",
        "points are left out at random; search + refinement",
        {
            f"{count} points": {
                "transform": partial(thin, num_points=count),
                "paper": f"{seconds} (RTX 2080)",
            }
            for count, seconds in RUNTIMES.items()
        },
    ),
    "variants": Experiment("splits of the data, such as changed scenes or light", "a line a split", None),
}


def cells(condition: Condition, rows: Sequence[QueryResult]) -> dict[str, str]:
    """Return the line of a condition by its columns, the paper's figure at its end."""
    seconds = {s: [row.result.seconds.get(s, 0.0) for row in rows] for s in ("search", "refine")}
    return {
        "": condition.name,
        "preset": condition.preset,
        **statistics(rows),
        **{f"{stage} s": f"{np.median(values):.2f}" for stage, values in seconds.items()},
        "the paper": condition.paper,
    }


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


def add_arguments(parser: ArgumentParser) -> None:
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
    condition: Condition, scenes: Sequence[Scene], out: Path, arguments: Arguments
) -> tuple[list[QueryResult], int]:
    """Return the results under one condition, and how many queries could not be localized."""
    transformed = []
    num_failed = 0
    with tempfile.TemporaryDirectory(prefix="piccolo-") as temporary:
        for number, scene in enumerate(scenes):
            folder = Path(temporary) / str(number)
            folder.mkdir()
            try:
                transformed.append(condition.transform(scene, folder) if condition.transform else scene)
            except InputError as error:
                arguments.error(str(error))
                num_failed += len(scene.queries)
        cache = CachePolicy(True, Path(temporary))
        config = Localizer((), condition.settings, BY_FILE, Photo(Path()), cache)
        variants = condition.variants or arguments.variants  # those of a condition are of the wanted
        path = out / file_name(condition)
        rows, num_failed_later = run_scenes(arguments, path, config, transformed, variants)
    return rows, num_failed + num_failed_later


def run_experiment(
    name: str, scenes: Sequence[Scene], presets: Sequence[Settings], arguments: Arguments
) -> int:
    """All conditions of an experiment and its table; returns how many queries were not localized."""
    experiment = EXPERIMENTS[name]
    folder: Path = arguments.out / name
    page: Path = arguments.out / f"{name}.md"
    variants = sorted({query.variant for scene in scenes for query in scene.queries})
    variants = [variant for variant in variants if not arguments.variants or variant in arguments.variants]
    num_failed = 0
    found = []
    conditions = conditions_of(experiment, presets, variants)
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
    text = table_of([cells(*one) for one in found], title, num_left=2).markdown()
    print(text, flush=True)
    write_atomically(page, text.encode())
    return num_failed


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Run the experiments one by one; returns the exit code."""
    arguments.check_least(jobs=1, threads=1)
    check_folder_name("--out", arguments.out)
    with checking_options():
        check_execution(arguments)
        limit_memory(arguments.max_memory)
    presets = [PRESETS[name] for name in arguments.presets]
    scenes = find_scenes(arguments.scenes)
    failed = [run_experiment(name, scenes, presets, arguments) for name in arguments.names]
    return EXIT_BAD_INPUT if any(failed) else 0
