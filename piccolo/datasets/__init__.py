"""Research datasets, read from their own folders and written as scenes with true poses."""

from collections.abc import Callable
from dataclasses import dataclass

from . import stanford
from .model import Listing, Request

__all__ = ["DATASETS", "Dataset"]


@dataclass(frozen=True)
class Dataset:
    """A dataset that can be converted."""

    about: str  # in a line
    listing: Callable[[Request], Listing]  # InputError if there is nothing of it in the folder


DATASETS = {
    stanford.NAME: Dataset("Stanford2D-3D-S panoramas with S3DIS room clouds", stanford.listing),
}
