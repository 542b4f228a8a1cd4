"""Writes the scenes of datasets as folders that piccolo/scene.py reads, each whole or not at all."""

import json
import math
import os
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np

from piccolo.cloud import open_source
from piccolo.cloud.readers.reader import CHUNK
from piccolo.cloud.settings import IN_COLORS
from piccolo.cloud.stream import PointValidator
from piccolo.cloud.writers import vertex_rows, writing_ply
from piccolo.errors import InputError, unreadable
from piccolo.files.atomic import check_output_folder, replacing_folder, write_atomically
from piccolo.geometry.pose import move, transform_points
from piccolo.jobs.threads import Progress, no_progress
from piccolo.scene import CLOUD_NAME, QUERIES_NAME, Query, read_scene, write_queries
from piccolo.views.pictures import encode_image

from .model import PosedPanorama, SceneSpec


class Written(NamedTuple):
    """The scene that was written, or was there already."""

    folder: Path
    num_points: int | None  # None if it was there already
    num_queries: int
    warnings: tuple[str, ...] = ()  # one line each, for the user


def write_scene(spec: SceneSpec, out: Path, copies: bool = False, show: Progress = no_progress) -> Written:
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
    validator = PointValidator(spec.cloud[0].path, 1.0)  # one for all files, as an object may be small
    warnings: list[str] = []
    with writing_ply(path) as writer:
        for part in spec.cloud:
            source = open_source(part.path, IN_COLORS)
            warnings += source.warnings
            validator.path = part.path
            total = None if source.num_points is None else math.ceil(source.num_points / CHUNK)
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
