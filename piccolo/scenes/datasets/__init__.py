"""Research datasets, read from their own folders and written as scenes with true poses."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from . import generic, loc360, matterport, mpo, omniscenes, stanford
from .model import ConvertOptions, PosedPanorama, SceneList, SceneSpec

__all__ = ["DATASETS", "Dataset"]


class Dataset(NamedTuple):
    """A dataset that can be converted."""

    description: str  # in a line
    find: Callable[[ConvertOptions], SceneList]

    def list_scenes(self, options: ConvertOptions) -> SceneList:
        """The scenes in a folder; InputError if there are none. None is read from files outside of it."""
        found = self.find(options)
        specs = [replace(spec, read_panoramas=partial(_read_inside, options, spec)) for spec in found.specs]
        return found._replace(specs=tuple(specs))


def _read_inside(options: ConvertOptions, spec: SceneSpec) -> list[PosedPanorama]:
    """The panoramas of a scene; InputError if its cloud or one of their files lies outside."""
    for part in spec.cloud:
        options.inside(part.path)
    panoramas = spec.read_panoramas()
    for panorama in panoramas:
        for file in panorama.files.values():
            options.inside(file)
    return panoramas


DATASETS = {
    stanford.NAME: Dataset("Stanford2D-3D-S panoramas with S3DIS room clouds", stanford.list_scenes),
    omniscenes.NAME: Dataset("OmniScenes, all splits", omniscenes.list_scenes),
    mpo.NAME: Dataset("MPO scans with panoramas, moved at random as in the PICCOLO paper", mpo.list_scenes),
    matterport.NAME: Dataset("Matterport3D skyboxes and house meshes", matterport.list_scenes),
    loc360.NAME: Dataset("360Loc 360-degree queries, with a cloud of your own", loc360.list_scenes),
    generic.NAME: Dataset("any panoramas with poses in a CSV, JSON or TUM file", generic.list_scenes),
}
