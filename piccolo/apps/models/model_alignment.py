"""Models of structure from motion, moved into the scan's coordinates with scale.

Rotation, scale and position are those of the bundle that localized photos and the model's poses make.
"""

import itertools
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from ...api.values import Result
from ...geometry.pose import Pose, log_so3
from ...geometry.pose_gaussian import PoseGaussian, subtract
from ...poses.bundle_adjustment import (
    UNKNOWN_SCALE,
    Bundle,
    Estimate,
    RelativeErrors,
    adjust,
    choose_agreed,
    find_odd,
    match_median,
    move_origin_near,
)
from ...poses.model_poses import read_reconstruction, transform_of_shot
from ...poses.relative_poses import read_relative_poses, read_xml
from ...system.arrays import Array
from ...system.errors import InputError, import_optional
from ...system.files.atomic import write_atomically, write_json, write_lines
from ...system.files.json_file import naming
from ..export.colmap import read_model, write_model

LEAST_MODEL_PHOTOS = 3
MOST_SCALE = 0.1  # chosen: deviation of the logarithm of a scale that is still told
MADE = 1e-3  # chosen: of a deviation; a pose that was computed is nearer to where it was put
NUM_MODEL_ROUNDS = 4  # in which the errors of the model and its place are estimated in turn
WANTED_OPENSFM = "wanted OpenSfM's reconstruction.json; of another model take the matrix"
LOCAL = (
    'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'
)


class Alignment(NamedTuple):
    """The similarity x_scan = scale R_scan_from_model x_model + translation, and how well photos agree."""

    scale: float
    R_scan_from_model: Array
    translation: Array  # (3,) [m]
    std: Array  # (7,) of rotation [rad] about the model's axes, place of its middle [m], logarithm of scale
    contradicting: tuple[str, ...]
    steps: Array  # (N, 6) of photos from where the model puts them [rad, m]
    is_independent: bool  # False if the photos' poses were made of the model's, so that steps say nothing

    @property
    def T_scan_from_model(self) -> Array:
        """The similarity as a matrix (4, 4)."""
        return np.vstack([np.c_[self.scale * self.R_scan_from_model, self.translation], [0.0, 0.0, 0.0, 1.0]])


def file_of_poses(model: Path) -> Path:
    """Return the file with the poses of a model: images.bin or images.txt of a folder, else itself."""
    if not model.is_dir():
        return model
    return next((model / name for name in ("images.bin", "images.txt") if (model / name).exists()), model)


def fit_alignment(model: Path, results: Sequence[Result]) -> Alignment:
    """Fit the similarity of a model to photos that are localized.

    InputError for fewer than three of them, and for places too near to each other to tell the scale.
    """
    sure = [(Path(result.pano), result) for result in results if result.pose is not None]
    relative = read_relative_poses(file_of_poses(model), [path for path, _ in sure])
    known = [(result, pose) for (_, result), pose in zip(sure, relative, strict=True) if pose is not None]
    if len(known) < LEAST_MODEL_PHOTOS:
        found = f"found {len(known)} localized photos of it in the results"
        raise InputError(f"{model}: {found}, wanted {LEAST_MODEL_PHOTOS} or more")
    middle = np.mean([pose.center_world for _, pose in known], axis=0)
    near = move_origin_near([pose for _, pose in known])
    none = np.zeros((6, 6))
    estimates = [
        Estimate(PoseGaussian(result.pose, result.pose_errors, none), pose)
        for (result, _), pose in zip(known, near, strict=True)
        if result.pose is not None
    ]
    free = RelativeErrors(log_scale=UNKNOWN_SCALE)
    bundle = _begin(estimates, free)
    own_covariances = [own.own for own, _ in estimates]
    errors = free
    for _ in range(NUM_MODEL_ROUNDS):
        adjusted = adjust(bundle, estimates, errors)
        bundle = adjusted.bundle
        steps = _find_steps(estimates, bundle)
        errors = match_median(own_covariances, steps, errors)
    odd = itertools.compress([result.pano for result, _ in known], find_odd(own_covariances, steps, errors))
    scale = math.exp(bundle.log_scale)
    R = bundle.pose.R_cam_from_world.T
    translation = bundle.pose.center_world - scale * R @ middle
    is_independent = _are_independent(own_covariances, steps)
    # each pose of a bundle has the errors of the whole: together they tell no more than one
    covariance = adjusted.covariance * (1.0 if is_independent else len(known))
    std = np.sqrt(np.diag(covariance))
    _check_scale(model, scale, float(std[6]), estimates)
    return Alignment(scale, R, translation, std, tuple(odd), steps, is_independent)


def _check_scale(model: Path, scale: float, std: float, estimates: Sequence[Estimate]) -> None:
    """Refuse photos so near to each other that the logarithm of the scale has a large deviation."""
    if std > MOST_SCALE:
        extent = float(np.linalg.norm(np.ptp([own.pose.center_world for own, _ in estimates], axis=0)))
        found = f"found {len(estimates)} localized photos within {extent:.2g} m, which tell no scale"
        wanted = "wanted photos at other places too"
        raise InputError(f"{model}: {found} ({scale:.3g} +- {scale * std:.2g}), {wanted}")


def _are_independent(covariances: Sequence[Array], steps: Array) -> bool:
    """Return False if most photos are where the model puts them as no photo is that was localized alone."""
    deviations = np.sqrt([np.diag(covariance) for covariance in covariances])
    return bool(np.median(np.abs(steps / deviations).max(axis=1)) > MADE)


def _begin(estimates: Sequence[Estimate], errors: RelativeErrors) -> Bundle:
    """Return the bundle by one photo that most others agree with; its scale is a median of distances."""
    own = np.array([one.pose.center_world for one, _ in estimates])
    given = np.array([pose.center_world for _, pose in estimates])
    rows, columns = np.triu_indices(len(own), 1)
    lengths = [np.linalg.norm(centers[rows] - centers[columns], axis=1) for centers in (own, given)]
    log_scale = math.log(max(float(np.median(lengths[0] / np.maximum(lengths[1], 1e-12))), 1e-12))
    frame = Bundle(Pose(np.eye(3), np.zeros(3)), log_scale)
    bundles = [Bundle(frame.scale(pose).inverse() @ one.pose, log_scale) for one, pose in estimates]
    return choose_agreed(bundles, partial(_find_steps, estimates), errors)


def _find_steps(estimates: Sequence[Estimate], bundle: Bundle) -> Array:
    """Return the steps (N, 6) of photos from where a bundle puts them."""
    return np.array([subtract(own.pose, bundle.place(pose)) for own, pose in estimates])


def write_matrix(alignment: Alignment, out: Path) -> None:
    """Write the matrix as four lines of four numbers, as CloudCompare and MeshLab take it."""
    write_lines(out, [" ".join(map(repr, row)) for row in alignment.T_scan_from_model.tolist()])


def write_aligned(model: Path, alignment: Alignment, out: Path) -> None:
    """Write the whole model, moved: a new folder of COLMAP's files, or the file of another program."""
    if model.is_dir():
        pycolmap = import_optional("COLMAP", "pycolmap", "colmap")
        reconstruction = read_model(model)
        rotation = pycolmap.Rotation3d(alignment.R_scan_from_model)
        reconstruction.transform(pycolmap.Sim3d(alignment.scale, rotation, alignment.translation))
        write_model(reconstruction, out)
        return
    if model.suffix == ".json":
        _write_opensfm(model, alignment, out)
        return
    root = read_xml(model)
    frames = [*root.iter("component")] or [*root.iter("chunk")]
    if len(frames) != 1:
        raise InputError(f"{model}: found {len(frames)} components or chunks, wanted one")
    for old in frames[0].findall("transform"):
        frames[0].remove(old)
    transform = ElementTree.SubElement(frames[0], "transform")
    parts: dict[str, Array] = {"rotation": alignment.R_scan_from_model, "translation": alignment.translation}
    for name, values in {**parts, "scale": np.array(alignment.scale)}.items():
        ElementTree.SubElement(transform, name).text = " ".join(map(repr, values.ravel().tolist()))
    for reference in root.iter("reference"):
        if reference.text and reference.text.strip():
            reference.text = LOCAL
    write_atomically(out, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _write_opensfm(model: Path, alignment: Alignment, out: Path) -> None:
    """Write a reconstruction.json: poses of shots and rigs, points; what refers to the globe is left out."""
    document = read_reconstruction(model, WANTED_OPENSFM)
    scale, R_scan_from_model, translation, *_ = alignment
    with naming(model, WANTED_OPENSFM):
        for part in document:
            part.pop("reference_lla", None)
            for posed in [*part["shots"].values(), *part.get("rig_instances", {}).values()]:
                T = transform_of_shot(posed)
                R = T[:, :3] @ R_scan_from_model.T
                posed["rotation"] = log_so3(R).tolist()
                posed["translation"] = (scale * T[:, 3] - R @ translation).tolist()
            for camera in part.get("rig_cameras", {}).values():
                camera["translation"] = (scale * np.array(camera["translation"], float)).tolist()
            for point in part.get("points", {}).values():
                placed = scale * R_scan_from_model @ np.array(point["coordinates"], float) + translation
                point["coordinates"] = placed.tolist()
    write_json(out, document)
