"""Write research datasets, or your own panoramas with known poses, as scenes that tools/evaluate.py reads."""

import json
import math
import os
import shutil
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from piccolo.cli.command import Arguments, add_command, check_folder_name, command, option
from piccolo.cloud.cloud_settings import IN_COLORS
from piccolo.cloud.octree import build_octree
from piccolo.cloud.point_validator import PointValidator
from piccolo.cloud.readers.reader import POINTS_A_CHUNK
from piccolo.cloud.stream import open_cloud, open_source
from piccolo.cloud.writers import vertex_rows, writing_ply
from piccolo.evidence.occlusion import AGREEMENT_WIDTH, measure_agreement
from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Pose, move, transform_points
from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.panorama import shrink
from piccolo.photo.panorama.picture import encode_image
from piccolo.system.arrays import Array
from piccolo.system.errors import InputError, unreadable
from piccolo.system.files.atomic import check_output_folder, replacing_folder, write_atomically
from piccolo.system.jobs.threads import Progress, Workers

from ..scene import CLOUD_NAME, QUERIES_NAME, Query, Scene, read_scene, write_queries
from . import generic, papers
from .model import AXES, DIRECTIONS, ConvertOptions, PosedPanorama, SceneList, SceneSpec

DATASETS = {  # a line on each, and what finds its scenes
    papers.STANFORD: ("Stanford2D-3D-S panoramas with S3DIS room clouds", papers.list_stanford),
    papers.OMNISCENES: ("OmniScenes, all splits", papers.list_omniscenes),
    papers.MPO: ("MPO scans with panoramas, moved randomly as in the PICCOLO paper", papers.list_mpo),
    papers.MATTERPORT: ("Matterport3D skyboxes and house meshes", papers.list_matterport),
    papers.LOC360: ("360Loc 360-degree queries, with a cloud of your own", papers.list_360loc),
    generic.NAME: ("any panoramas with poses in a CSV, JSON or TUM file", generic.list_scenes),
}

EXIT_BAD_FIT = 1
_DATASETS = "\n".join(f"  {name:<14} {text}" for name, (text, _) in DATASETS.items())
EPILOG = f"""\
datasets:
{_DATASETS}

example:
  python tools/convert_dataset.py stanford2d3ds --from data/stanford --out scenes --areas 1 3 --check 3

Writes OUT/SCENE/cloud.ply, images/ (links to the dataset's files, or copies), labels/ and queries.json.
research/DATASETS.md describes them, and the folders and poses of each dataset. A scene that exists is left..
A scene with a damaged file is left out and named on stderr. Prints one JSON object per scene.
"""
MIN_SCORE = 0.1  # other views of the same place may have as much, but seldom more than the right one
AS_GIVEN = "as given"


class ConventionCheck(NamedTuple):
    """The fit of a panorama to the cloud at its pose, by this convention and by others."""

    image: str  # as queries.json has it
    score: float  # of the pose as given, [-1, 1], by evidence/occlusion.py
    best_score: float  # the highest score by any convention
    best: str  # that convention in words


class Check(NamedTuple):
    """The checks of some panoramas of a scene."""

    panoramas: tuple[ConventionCheck, ...]

    @property
    def is_passed(self) -> bool:
        """True if more than half of them fit, and no other convention fits better."""
        num_good = sum(check.best == AS_GIVEN and check.score >= MIN_SCORE for check in self.panoramas)
        return 2 * num_good > len(self.panoramas)

    @property
    def advice(self) -> str:
        """A line for the user that says what is wrong."""
        (best, count), *_ = Counter(check.best for check in self.panoramas).most_common()
        scores = ", ".join(f"{check.score:.2f}" for check in self.panoramas)
        text = f"the poses don't fit the panoramas: scores {scores}, wanted {MIN_SCORE} or more"
        if best != AS_GIVEN and 2 * count > len(self.panoramas):
            found = np.median([check.best_score for check in self.panoramas if check.best == best])
            return f"{text}; {found:.2f} if {best}"
        return f"{text}; no other axes fit better"


def check_scene(scene: Scene, num_queries: int, workers: Workers) -> Check:
    """Score some panoramas of a scene, evenly spaced over the list, against its cloud at their poses."""
    voxels = open_cloud([scene.cloud], IN_COLORS, workers.show).voxels(np.eye(3))
    nodes = build_octree(voxels).level(0.08)  # [m] enough for views of a few degrees
    points = pack_points(nodes[:, :3], np.round(nodes[:, 3:] * 255.0).astype(np.uint8))

    def check(query: Query) -> ConventionCheck:
        pose = Pose(query.pose.R_cam_from_world, query.pose.center_world - voxels.origin)
        panorama = shrink(read_panorama(query.image), AGREEMENT_WIDTH)  # once for all variants
        variants = convention_variants(pose, voxels.origin)
        scores = {
            words: measure_agreement(points, panorama, variant).score for words, variant in variants.items()
        }
        best = max(scores, key=lambda words: scores[words])
        return ConventionCheck(scene.name_of(query), scores[AS_GIVEN], scores[best], best)

    count = len(scene.queries)
    spaced = np.linspace(0, count - 1, min(num_queries, count)).round().astype(int)  # evenly
    chosen = [scene.queries[k] for k in spaced]
    return Check(tuple(workers.map(check, chosen, f"{scene.name}: check")))


def convention_variants(pose: Pose, origin: Array) -> dict[str, Pose]:
    """Return the pose under each convention that may have been mixed up, by its name.

    The camera's axes in any order and sign; and the rotation, or the whole transform, of a camera with known
    axes inverted. Positions are less `origin`.
    """
    inverted = {"": pose}
    for axes, other_from_cam in AXES.items():
        R = other_from_cam @ pose.R_cam_from_world
        R_inverted = other_from_cam.T @ R.T
        position = -R @ (pose.center_world + origin) - origin
        inverted[f"the rotation in {axes} axes is inverted"] = Pose(R_inverted, pose.center_world)
        inverted[f"the transform in {axes} axes is inverted"] = Pose(R_inverted, position)
    poses = {}
    for words, variant in inverted.items():
        for turn in axis_rotations():
            is_same = np.array_equal(turn, np.eye(3))
            named = "" if is_same else f"the camera's x, y, z are {describe_axes(turn)}"
            text = " and ".join(filter(None, (words, named))) or AS_GIVEN
            poses[text] = Pose(turn @ variant.R_cam_from_world, variant.center_world)
    return poses


def axis_rotations() -> Array:
    """Return the 24 rotations (24, 3, 3) that take axes to axes, one of them the identity."""
    return np.asarray(np.round(Rotation.create_group("O").as_matrix()))


def describe_axes(turn: Array) -> str:
    """Return a rotation of axis_rotations in words: the given axis, with its sign, in each row."""
    return ", ".join(f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in turn)


def add_arguments(parser: ArgumentParser) -> None:
    """All options; those that one dataset alone has are in its own subparser."""
    subparsers = parser.add_subparsers(dest="dataset", required=True, metavar="DATASET")
    for name, (description, _) in DATASETS.items():
        one = add_command(subparsers, name, description=description)
        option(one, "--from FOLDER", "folder of the dataset", required=True, dest="folder")
        option(one, "--out FOLDER", "folder of the scenes; created if missing", required=True)
        text = "only these, the last parts of scene names: office_1, weddingHall_1, a house"
        option(one, "--rooms NAME ...", text, default=[])
        option(one, "--check N", "check the poses of N panoramas of each scene against its cloud", default=0)
        text = "copy the panoramas, so that the dataset can be deleted (default: link to them)"
        option(one, "--copy", text)
        add_own_options(one, name)


def add_own_options(parser: ArgumentParser, dataset: str) -> None:
    """Add the options of one dataset alone; of `generic` those where the list has no column."""
    if dataset == "stanford2d3ds":
        option(parser, "--areas 1-6 ...", "only these areas", default=[])
        text = "write clouds with a label per point (from Annotations), and labels/ of the panoramas"
        option(parser, "--labels", text)
    elif dataset == "mpo":
        option(parser, "--seed N", "seed of the random transforms", default=0)
    elif dataset == "generic":
        option(parser, "--poses FILE", "list of poses (default: poses.csv, .json, .txt or .tum in --from)")
        option(parser, "--cloud FILE", "cloud of the scene (default: the only cloud in --from)")
        option(parser, "--images FOLDER", "pictures named by their times (default: images in --from)")
        text = "piccolo: forward, left, up; optical: right, down, forward; opengl: right, up, back"
        option(parser, "--axes", f"axes of the camera; {text}", choices=AXES)
        text = "direction of the transform [R | t] of a row"
        option(parser, "--direction", text, choices=DIRECTIONS)


def list_scenes(dataset: str, options: ConvertOptions) -> SceneList:
    """Return the scenes in a folder; InputError if there are none. None is read from files outside of it."""
    _, find = DATASETS[dataset]
    found = find(options)
    specs = (spec._replace(panoramas=_inside(options, spec)) for spec in found.specs)
    return found._replace(specs=tuple(specs))


def _inside(options: ConvertOptions, spec: SceneSpec) -> Iterator[PosedPanorama]:
    """Yield the panoramas of a scene; InputError if its cloud or one of their files lies outside."""
    for part in spec.cloud:
        options.inside(part.path)
    for panorama in spec.panoramas:
        for file in panorama.files.values():
            options.inside(file)
        yield panorama


def choose_scenes(specs: tuple[SceneSpec, ...], rooms: list[str]) -> list[SceneSpec]:
    """Return the scenes of some rooms, or all."""
    counts = Counter(spec.name for spec in specs)
    if twice := [name for name, count in counts.items() if count > 1]:
        raise InputError(f"--from: found the scene {twice[0]} twice")
    names = {spec.name.split("/")[-1] for spec in specs}
    if missing := [room for room in rooms if room not in names]:
        raise InputError(f"--rooms: found no {missing[0]}, wanted one of {', '.join(sorted(names))}")
    return [spec for spec in specs if not rooms or spec.name.split("/")[-1] in rooms]


class Written(NamedTuple):
    """The scene that was written, or was there already."""

    folder: Path
    num_points: int | None  # None if it was there already
    num_queries: int
    warnings: tuple[str, ...] = ()  # one line each, for the user


def write_scene(spec: SceneSpec, out: Path, copies: bool, show: Progress) -> Written:
    """Write a scene below `out`, with links to its pictures or copies, or leave it as it is if it is there.

    Raises InputError if a file of the scene is damaged or missing, there is no panorama, or what is there was
    made otherwise.
    """
    folder = out / spec.name
    if (folder / QUERIES_NAME).exists():
        scene = read_scene(folder)
        source = json.loads((folder / QUERIES_NAME).read_text()).get("source")
        if source != spec.source:
            found = f"found a scene of {json.dumps(source)}, wanted {json.dumps(spec.source)}"
            raise InputError(f"{folder}: {found}: remove it, or change `out`")
        return Written(folder, None, len(scene.queries))
    folder.parent.mkdir(parents=True, exist_ok=True)
    check_output_folder(folder)
    panoramas = list(spec.panoramas)
    if not panoramas:
        raise InputError(f"{spec.cloud[0].path}: found no panorama with a pose for it")
    with replacing_folder(folder) as unfinished:
        num_points, warnings = _write_cloud(spec, unfinished / CLOUD_NAME, show)
        queries = [_write_panorama(spec, panorama, unfinished, copies) for panorama in panoramas]
        write_queries(unfinished, queries, source=spec.source)
    return Written(folder, num_points, len(queries), tuple(warnings))


def _write_cloud(spec: SceneSpec, path: Path, show: Progress) -> tuple[int, list[str]]:
    """Stream the finite points of the cloud's files into one PLY; returns how many it has, and warnings."""
    T = spec.T_written_from_dataset
    validator = PointValidator(spec.cloud[0].path, np.ones(3))  # one for all files, as an object may be small
    warnings: list[str] = []
    with writing_ply(path) as writer:
        for part in spec.cloud:
            source = open_source(part.path, IN_COLORS)
            warnings += source.warnings
            validator.path = part.path
            validator.units = np.array(source.units)
            total = None if source.num_points is None else math.ceil(source.num_points / POINTS_A_CHUNK)
            try:
                for raw in show(source.read_chunks(), total, f"{spec.name}: {part.path.name}"):
                    points, colors = validator.filter(raw)
                    moved = points if T is None else transform_points(points, T)
                    labels = None if part.label is None else np.full(len(points), part.label, np.int32)
                    writer.add(vertex_rows(moved, colors, label=labels))
            except OSError as error:
                raise unreadable(part.path, error) from error
        validator.check()
    return validator.num_finite, [*warnings, *validator.warnings()]


def _write_panorama(spec: SceneSpec, panorama: PosedPanorama, folder: Path, copies: bool) -> Query:
    for name, file in panorama.files.items():
        if not (file.is_file() and os.access(file, os.R_OK)):
            raise InputError(f"{file}: no such panorama, or no permission to read it")
        target = folder / "images" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if copies:
            shutil.copyfile(file, target)
        else:
            target.symlink_to(file.resolve())
    labels = None
    if panorama.read_labels is not None:
        labels = (folder / "labels" / panorama.name).with_suffix(".png")
        labels.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(labels, encode_image(panorama.read_labels(), ".png"))  # 16 bits, one channel
    T = spec.T_written_from_dataset
    pose = panorama.pose if T is None else move(panorama.pose, T, 1.0)
    return Query(folder / "images" / panorama.name, panorama.variant, pose, labels)


@command(__file__, __doc__, EPILOG, add_arguments, "0 done, 1 --check found poses that don't fit")
def main(arguments: Arguments) -> int:
    """Write the scenes one by one; returns the exit code."""
    arguments.check_least(check=0, seed=0)
    check_folder_name("--out", arguments.out)
    # a dataset's subparser has only some of the options
    own = {field.name: getattr(arguments, field.name, field.default) for field in fields(ConvertOptions)}
    options = ConvertOptions(**own | {"areas": frozenset(getattr(arguments, "areas", ()))})
    found = list_scenes(arguments.dataset, options)
    specs = choose_scenes(found.specs, arguments.rooms)
    for note in found.notes:
        arguments.note(note)
    workers = arguments.workers()
    # bad input goes before a bad fit
    return max((convert_scene(spec, arguments, workers) for spec in specs), default=0)


def convert_scene(spec: SceneSpec, arguments: Arguments, workers: Workers) -> int:
    """Write a scene, check it, and print its line; returns the exit code."""
    try:
        written = write_scene(spec, arguments.out, arguments.copy, workers.show)
        check = None
        if arguments.check:
            check = check_scene(read_scene(written.folder, spec.name), arguments.check, workers)
    except InputError as error:
        return arguments.error(f"{spec.name}: {error}")
    for warning in written.warnings:
        arguments.note(warning)
    status = "there already" if written.num_points is None else "written"
    line: dict[str, object] = {"scene": spec.name, "folder": str(written.folder), "status": status}
    line |= {"points": written.num_points, "queries": written.num_queries}
    if check:
        line |= {"fits": check.is_passed, "check": [panorama._asdict() for panorama in check.panoramas]}
    print(json.dumps(line), flush=True)
    if check and not check.is_passed:
        return arguments.error(f"{spec.name}: {check.advice}", EXIT_BAD_FIT)
    return 0
