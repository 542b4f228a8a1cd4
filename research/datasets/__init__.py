"""Research datasets, read from their own folders and written as scenes with true poses."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from . import generic, research, stanford
from .model import ConvertOptions, PosedPanorama, SceneList, SceneSpec

__all__ = ["DATASETS", "Dataset"]


class Dataset(NamedTuple):
    """A dataset that can be converted."""

    description: str  # in a line
    find: Callable[[ConvertOptions], SceneList]

    def list_scenes(self, options: ConvertOptions) -> SceneList:
        """Return the scenes in a folder.

        InputError if there are none. None is read from files outside of it.
        """
        found = self.find(options)
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


DATASETS = {
    stanford.NAME: Dataset("Stanford2D-3D-S panoramas with S3DIS room clouds", stanford.list_scenes),
    research.OMNISCENES: Dataset("OmniScenes, all splits", research.list_omniscenes),
    research.MPO: Dataset(
        "MPO scans with panoramas, moved randomly as in the PICCOLO paper", research.list_mpo
    ),
    research.MATTERPORT: Dataset("Matterport3D skyboxes and house meshes", research.list_matterport),
    research.LOC360: Dataset("360Loc 360-degree queries, with a cloud of your own", research.list_360loc),
    generic.NAME: Dataset("any panoramas with poses in a CSV, JSON or TUM file", generic.list_scenes),
}
