"""What a reader of a dataset finds: the scenes that can be written, with their clouds and panoramas."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...geometry.point_transforms import rotate_points
from ...geometry.pose import Array, Pose

Labels = NDArray[np.uint16]  # (H, W) what each pixel shows, 0 where nobody says


@dataclass(frozen=True)
class Request:
    """What the user wants of a dataset."""

    folder: Path
    areas: frozenset[str] = frozenset()  # of Stanford2D-3D-S, as in its folders' names; all if empty
    labels: bool = False
    seed: int = 0  # of MPO's motions
    # of `generic`
    poses: Path | None = None
    cloud: Path | None = None
    images: Path | None = None
    axes: str | None = None
    direction: str | None = None


@dataclass(frozen=True)
class CloudPart:
    """A file with points of a scene, in any format that is read here."""

    path: Path
    label: int = 0  # of all its points


@dataclass(frozen=True)
class Shot:
    """A panorama with its true pose in the dataset's cloud."""

    name: str  # below images/
    files: Mapping[str, Path]  # by name below images/: the picture, or the faces in the folder `name`
    variant: str
    pose: Pose
    read_labels: Callable[[], Labels] | None = None


@dataclass(frozen=True)
class Motion:
    """x_written = R_written_from_dataset @ x_dataset + shift."""

    R_written_from_dataset: Array  # (3, 3)
    shift: Array  # (3,) [m]

    def of_points(self, points: Array) -> Array:
        """Points (N, 3) moved."""
        return rotate_points(points, self.R_written_from_dataset) + self.shift

    def of_pose(self, pose: Pose) -> Pose:
        """The same camera, moved with the points."""
        center_world = self.R_written_from_dataset @ pose.center_world + self.shift
        return Pose(pose.R_cam_from_world @ self.R_written_from_dataset.T, center_world)


@dataclass(frozen=True)
class Plan:
    """A scene that can be written. Its files are opened when it is."""

    name: str  # its folder below the output: a room, or area/room
    cloud: tuple[CloudPart, ...]
    read_shots: Callable[[], list[Shot]]  # InputError naming the file where a pose is damaged
    motion: Motion | None = None
    has_labels: bool = False
    source: Mapping[str, object] = field(default_factory=dict)  # for queries.json: how it was made


@dataclass(frozen=True)
class Listing:
    """The scenes of a dataset."""

    plans: tuple[Plan, ...]
    notes: tuple[str, ...] = ()  # one line each, for the user: what is passed over
