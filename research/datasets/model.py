"""The scenes that are found in a dataset, before they are written."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from piccolo import InputError, Pose
from piccolo.arrays import Array

Labels = NDArray[np.uint16]  # (H, W) the class of each pixel, 0 where unknown


@dataclass(frozen=True)
class ConvertOptions:
    """Which scenes of a dataset to convert, and how."""

    folder: Path
    areas: frozenset[str] = frozenset()  # of Stanford2D-3D-S, as in its folders' names; all if empty
    labels: bool = False
    seed: int = 0  # of MPO's random transforms
    # of `generic`
    poses: Path | None = None
    cloud: Path | None = None
    images: Path | None = None
    axes: str | None = None
    direction: str | None = None

    @cached_property
    def _roots(self) -> list[str]:
        """The paths that the user named, which may be links themselves, without links."""
        named = self.folder, self.poses and self.poses.parent, self.cloud, self.images
        return [os.path.realpath(path) for path in named if path]

    def inside(self, path: Path, where: str = "") -> Path:
        """Return a file of the dataset, which is refused if it lies elsewhere, by a link or by "..".

        Where a list names it, `where` is the place in the list.
        """
        at = f"{where}: " if where else ""
        try:
            real = Path(os.path.realpath(path))
        except ValueError as error:  # a zero byte, half a character
            raise InputError(f"{at}found {str(path)!r}, wanted the name of a file") from error
        if not any(real.is_relative_to(root) for root in self._roots):
            leads = f"{at}{path} leads to {real}"
            raise InputError(f"{leads}, out of {self.folder}; move or copy the file into it")
        return path


class CloudPart(NamedTuple):
    """A file with points of a scene, in any format of piccolo.cloud."""

    path: Path
    label: int | None = None  # of all its points


class PosedPanorama(NamedTuple):
    """A panorama with its true pose in the dataset's cloud."""

    name: str  # below images/
    files: Mapping[str, Path]  # by name below images/: the picture, or the faces in the folder `name`
    variant: str
    pose: Pose
    read_labels: Callable[[], Labels] | None = None


class SceneSpec(NamedTuple):
    """A scene to be written; its files are opened only then."""

    dataset: str
    name: str  # its folder below the output: a room, or area/room
    cloud: tuple[CloudPart, ...]
    panoramas: Iterable[PosedPanorama]  # read as they come: InputError naming the file of a damaged pose
    T_written_from_dataset: Array | None = None  # (4, 4) [m], rigid
    settings: Mapping[str, object] = {}  # how it was made

    @property
    def source(self) -> dict[str, object]:
        """The data set and the settings, for queries.json."""
        return {"dataset": self.dataset, **self.settings}


class SceneList(NamedTuple):
    """The scenes of a dataset."""

    specs: tuple[SceneSpec, ...]
    notes: tuple[str, ...] = ()  # one line each, for the user: what is passed over


def scene_list(folder: Path, specs: Sequence[SceneSpec], missing: Sequence[str], layout: str) -> SceneList:
    """Return the scenes found in a folder, InputError if none; and a note on those that miss a cloud."""
    if not specs:
        raise InputError(f"{folder}: found no {layout}, wanted the layout in docs/DATASETS.md")
    notes = (f"{len(missing)} scenes without a cloud: {', '.join(missing)}",) if missing else ()
    return SceneList(tuple(specs), notes)
