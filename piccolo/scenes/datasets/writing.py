"""Scenes of datasets in the form of piccolo/scenes.py: each folder appears whole or not at all."""

import json
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ...cloud import open_source
from ...cloud.ply_writer import vertex_rows, writing_ply
from ...cloud.readers.reader import CHUNK
from ...cloud.validation import Chunk, PointValidator
from ...errors import InputError
from ...runtime.atomic import check_output_folder, replacing_folder
from ...runtime.threads import Show, unseen
from ..scene import CLOUD_NAME, QUERIES_NAME, Query, read_scene, write_queries
from .labels import write_labels
from .model import Plan, Shot

IMAGES, LABELS = "images", "labels"  # folders of a scene
Transfer = Literal["symlink", "copy"]


@dataclass(frozen=True)
class Written:
    """What was written of a scene, or found there."""

    folder: Path
    num_points: int | None  # None if it was there already
    num_queries: int
    warnings: tuple[str, ...] = ()  # one line each, for the user


def write_scene(plan: Plan, out: Path, transfer: Transfer = "symlink", show: Show = unseen) -> Written:
    """Write a scene below `out`, or leave it as it is if it is there.

    Raises
    ------
    InputError
        A file of the scene is damaged or missing, there is no panorama, or what is there was made otherwise.
    """
    folder = out / plan.name
    if (folder / QUERIES_NAME).exists():
        return _there_already(plan, folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    check_output_folder(folder)
    shots = plan.read_shots()
    if not shots:
        raise InputError(f"{plan.cloud[0].path}: found no panorama with a pose for it, wanted at least one")
    with replacing_folder(folder) as unfinished:
        warnings: list[str] = []
        num_points = _write_cloud(plan, unfinished / CLOUD_NAME, warnings, show)
        queries = [_write_shot(plan, shot, unfinished, transfer) for shot in shots]
        write_queries(unfinished, queries, source=dict(plan.source))
    return Written(folder, num_points, len(queries), tuple(warnings))


def _there_already(plan: Plan, folder: Path) -> Written:
    scene = read_scene(folder)
    source = json.dumps(json.loads((folder / QUERIES_NAME).read_text()).get("source"))
    wanted = json.dumps(dict(plan.source))
    if source != wanted:
        raise InputError(f"{folder}: found a scene of {source}, wanted {wanted}: remove it, or change --out")
    return Written(folder, None, len(scene.queries))


def _write_cloud(plan: Plan, path: Path, warnings: list[str], show: Show) -> int:
    """Stream the cloud's files into one PLY; returns how many points it has."""
    validator = PointValidator(plan.cloud[0].path, 1.0)
    dtype = vertex_rows(*_no_points(), np.empty(0, np.int32) if plan.has_labels else None).dtype
    with writing_ply(path, dtype) as writer:
        for (points, colors), label in _chunks(plan, validator, warnings, show):
            moved = points if plan.motion is None else plan.motion.of_points(points)
            labels = np.full(len(points), label, np.int32) if plan.has_labels else None
            writer.add(vertex_rows(moved, colors, labels))
        validator.check()
    warnings += validator.warnings()
    return validator.num_finite


def _no_points() -> Chunk:
    return np.empty((0, 3)), np.empty((0, 3), np.uint8)


def _chunks(
    plan: Plan, validator: PointValidator, warnings: list[str], show: Show
) -> Iterator[tuple[Chunk, int]]:
    """Finite points of all files with their labels; one validator for all, as an object may be small."""
    for part in plan.cloud:
        source = open_source(part.path)
        warnings += source.warnings
        validator.path = part.path
        total = None if source.num_points is None else math.ceil(source.num_points / CHUNK)
        try:
            for raw in show(source.read_chunks(), total, f"{plan.name}: {part.path.name}"):
                yield validator.filter(raw), part.label
        except OSError as error:
            text = f"{part.path}: cannot be read ({error.strerror or error}), wanted a whole file"
            raise InputError(text) from error


def _write_shot(plan: Plan, shot: Shot, folder: Path, transfer: Transfer) -> Query:
    for name, file in shot.files.items():
        _bring(file, folder / IMAGES / name, transfer)
    labels = None
    if shot.read_labels is not None:
        labels = (folder / LABELS / shot.name).with_suffix(".png")
        labels.parent.mkdir(parents=True, exist_ok=True)
        write_labels(labels, shot.read_labels())
    pose = shot.pose if plan.motion is None else plan.motion.of_pose(shot.pose)
    return Query(folder / IMAGES / shot.name, shot.variant, pose, labels)


def _bring(file: Path, target: Path, transfer: Transfer) -> None:
    """The picture at another place: a link, or a copy."""
    if not (file.is_file() and os.access(file, os.R_OK)):
        raise InputError(f"{file}: no such file that can be read, wanted a panorama")
    target.parent.mkdir(parents=True, exist_ok=True)
    if transfer == "symlink":
        target.symlink_to(file.resolve())
    else:
        shutil.copyfile(file, target)
