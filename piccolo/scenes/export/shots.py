"""From lines of JSON to the pictures and poses that are to be written."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...confidence.confidence import LOCALIZED
from ...errors import InputError
from ...geometry.pose import Pose
from ...result import Result
from ..scene import Scene
from .model import Format, Options, Shot, check_size
from .pictures import picture_size

TIMESTAMP = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True)
class Selection:
    """The results to write, and why others are not."""

    results: tuple[Result, ...]
    left_out: dict[str, int]  # how many, by status or "without a pose"

    @property
    def clouds(self) -> tuple[str, ...]:
        """The clouds of the results, in order."""
        return tuple(dict.fromkeys(result.cloud_name for result in self.results))


def true_results(scene: Scene) -> list[Result]:
    """The true poses of a scene, as if they had been found beyond doubt: a reference for other tools."""
    cloud = str(scene.cloud)
    return [
        Result(LOCALIZED, 1.0, cloud, str(query.image), query.pose, None, None, (), None, {}, {})
        for query in scene.queries
    ]


def select(results: Sequence[Result], clouds: Sequence[str] = (), use_all: bool = False) -> Selection:
    """The results with a pose that are localized, or all with a pose; those of `clouds` only, if given."""
    known = {result.cloud_name for result in results}
    if missing := [cloud for cloud in clouds if cloud not in known]:
        raise InputError(
            f"--cloud: found no result for {missing[0]}, wanted one of {', '.join(sorted(known))}"
        )
    chosen, left_out = [], Counter[str]()
    for result in results:
        if clouds and result.cloud_name not in clouds:
            left_out["other clouds"] += 1
        elif result.pose is None:
            left_out["without a pose"] += 1
        elif result.status != LOCALIZED and not use_all:
            left_out[result.status] += 1
        else:
            chosen.append(result)
    return Selection(tuple(chosen), dict(left_out))


def shots_of(results: Sequence[Result], form: Format, options: Options) -> list[Shot]:
    """Pictures and poses by the names, times and offset that the options ask for."""
    offset = np.array(options.offset or (0.0, 0.0, 0.0))
    shots: dict[str, Shot] = {}
    for index, result in enumerate(results):
        if result.pose is None:
            raise InputError(f"{result.pano}: found a result without a pose, wanted one with")
        name, path = _name(result.pano, options.images), Path(result.pano)
        if form.forbidden and (found := re.search(form.forbidden, name)):
            raise InputError(
                f"{name}: found {found.group()!r} in the name, wanted one that {form.name} can read"
            )
        if form.has_unique_names and name in shots:
            clouds = f"{shots[name].result.cloud_name}, {result.cloud_name}"
            raise InputError(
                f"{name}: found two results of it (clouds {clouds}), wanted one; --cloud chooses"
            )
        size = (0, 0)
        if "size" in form.options:
            size = options.size or picture_size(path)
            check_size(str(path), size)
        time = str(index) if options.timestamps == "index" else _timestamp(path)
        pose = Pose(result.pose.R_cam_from_world, result.pose.center_world - offset)
        key = name if form.has_unique_names else str(index)
        shots[key] = Shot(name, path, time, pose, size, result)
    return list(shots.values())


def _name(pano: str, images: Path | None) -> str:
    """The picture's name in the folder of images, with slashes; as given if there is no such folder."""
    if images is None:
        return Path(pano).as_posix()
    name = Path(os.path.relpath(pano, images))
    if ".." in name.parts:
        raise InputError(f"{pano}: found outside of --images {images}, wanted a picture in that folder")
    return name.as_posix()


def _timestamp(path: Path) -> str:
    if not TIMESTAMP.fullmatch(path.stem):
        raise InputError(f"{path}: found the name {path.stem!r}, wanted a number for --timestamps name")
    return path.stem
