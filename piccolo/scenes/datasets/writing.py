"""Writes the scenes of datasets as folders that are read by scenes/scene.py, each whole or not at all."""

import json
import math
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ...cloud import open_source
from ...cloud.ply_writer import vertex_rows, writing_ply
from ...cloud.readers.reader import CHUNK
from ...cloud.stream import Chunk, PointValidator
from ...errors import InputError, unreadable
from ...files.atomic import check_output_folder, replacing_folder
from ...jobs.threads import Progress, no_progress
from ..scene import CLOUD_NAME, QUERIES_NAME, Query, read_scene, write_queries
from .files import write_labels
from .model import PosedPanorama, SceneSpec

IMAGES, LABELS = "images", "labels"  # folders of a scene
Transfer = Literal["symlink", "copy"]


class Written(NamedTuple):
    """The scene that was written, or was there already."""

    folder: Path
    num_points: int | None  # None if it was there already
    num_queries: int
    warnings: tuple[str, ...] = ()  # one line each, for the user


def write_scene(
    spec: SceneSpec, out: Path, transfer: Transfer = "symlink", show: Progress = no_progress
) -> Written:
    """Write a scene below `out`, or leave it as it is if it is there.

    Raises InputError if a file of the scene is damaged or missing, there is no panorama, or what is there was
    made otherwise.
    """
    folder = out / spec.name
    if (folder / QUERIES_NAME).exists():
        scene = read_scene(folder)
        source = json.loads((folder / QUERIES_NAME).read_text()).get("source")
        if source != spec.source:
            found = f"found a scene of {json.dumps(source)}, wanted {json.dumps(spec.source)}"
            raise InputError(f"{folder}: {found}: remove it, or change --out")
        return Written(folder, None, len(scene.queries))
    folder.parent.mkdir(parents=True, exist_ok=True)
    check_output_folder(folder)
    panoramas = spec.read_panoramas()
    if not panoramas:
        raise InputError(f"{spec.cloud[0].path}: found no panorama with a pose for it")
    with replacing_folder(folder) as unfinished:
        warnings: list[str] = []
        num_points = _write_cloud(spec, unfinished / CLOUD_NAME, warnings, show)
        queries = [_write_panorama(spec, panorama, unfinished, transfer) for panorama in panoramas]
        write_queries(unfinished, queries, source=spec.source)
    return Written(folder, num_points, len(queries), tuple(warnings))


def _write_cloud(spec: SceneSpec, path: Path, warnings: list[str], show: Progress) -> int:
    """Stream the cloud's files into one PLY; returns how many points it has."""
    validator = PointValidator(spec.cloud[0].path, 1.0)
    nothing = np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.int32) if spec.has_labels else None
    dtype = vertex_rows(*nothing).dtype
    with writing_ply(path, dtype) as writer:
        for (points, colors), label in _chunks(spec, validator, warnings, show):
            moved = points if spec.transform is None else spec.transform.of_points(points)
            labels = np.full(len(points), label, np.int32) if spec.has_labels else None
            writer.add(vertex_rows(moved, colors, labels))
        validator.check()
    warnings += validator.warnings()
    return validator.num_finite


def _chunks(
    spec: SceneSpec, validator: PointValidator, warnings: list[str], show: Progress
) -> Iterator[tuple[Chunk, int]]:
    """Finite points of all files with their labels; one validator for all, as an object may be small."""
    for part in spec.cloud:
        source = open_source(part.path)
        warnings += source.warnings
        validator.path = part.path
        total = None if source.num_points is None else math.ceil(source.num_points / CHUNK)
        try:
            for raw in show(source.read_chunks(), total, f"{spec.name}: {part.path.name}"):
                yield validator.filter(raw), part.label
        except OSError as error:
            raise unreadable(part.path, error) from error


def _write_panorama(spec: SceneSpec, panorama: PosedPanorama, folder: Path, transfer: Transfer) -> Query:
    for name, file in panorama.files.items():
        if not (file.is_file() and os.access(file, os.R_OK)):
            raise InputError(f"{file}: no such panorama, or no permission to read it")
        target = folder / IMAGES / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if transfer == "symlink":
            target.symlink_to(file.resolve())
        else:
            shutil.copyfile(file, target)
    labels = None
    if panorama.read_labels is not None:
        labels = (folder / LABELS / panorama.name).with_suffix(".png")
        labels.parent.mkdir(parents=True, exist_ok=True)
        write_labels(labels, panorama.read_labels())
    pose = panorama.pose if spec.transform is None else spec.transform.of_pose(panorama.pose)
    return Query(folder / IMAGES / panorama.name, panorama.variant, pose, labels)
