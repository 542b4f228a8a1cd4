"""Research datasets, read from their own folders and written as scenes with true poses."""

from collections.abc import Callable
from typing import NamedTuple

from . import generic, loc360, matterport, mpo, omniscenes, stanford
from .model import ConvertOptions, SceneList

__all__ = ["DATASETS", "Dataset"]


class Dataset(NamedTuple):
    """A dataset that can be converted."""

    description: str  # in a line
    list_scenes: Callable[[ConvertOptions], SceneList]  # InputError if there is nothing of it in the folder


DATASETS = {
    stanford.NAME: Dataset("Stanford2D-3D-S panoramas with S3DIS room clouds", stanford.list_scenes),
    omniscenes.NAME: Dataset("OmniScenes, all splits", omniscenes.list_scenes),
    mpo.NAME: Dataset("MPO scans with panoramas, moved at random as in the PICCOLO paper", mpo.list_scenes),
    matterport.NAME: Dataset("Matterport3D skyboxes and house meshes", matterport.list_scenes),
    loc360.NAME: Dataset("360Loc 360-degree queries, with a cloud of your own", loc360.list_scenes),
    generic.NAME: Dataset("any panoramas with poses in a CSV, JSON or TUM file", generic.list_scenes),
}
