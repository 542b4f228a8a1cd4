"""Calibrations of single photos: a folder with a file for each, or a model that names each photo's camera.

A model is COLMAP's cameras file with its images file beside it, or OpenSfM's reconstruction.json.
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from ...system.files.json_file import naming, read_json
from ...system.files.photo_names import match_names
from .calibration import WANTED, Calibration, Mount, opensfm_cameras, read_calibration, read_colmap_cameras
from .foreign import is_reconstruction, read_images


def open_calibration(path: Path) -> Calibration | Path:
    """Return the cameras in a file, or, for a folder or a model, its path for `find_calibration`."""
    if path.is_dir():
        return path.absolute()
    calibration = read_calibration(path)
    is_model = calibration.is_choice and len(calibration.mounts) > 1 and find_images(path) is not None
    return path.absolute() if is_model else calibration


def find_calibration(opened: Calibration | Path | None, pano: Path) -> Calibration | None:
    """Return a photo's calibration; `opened` is what `open_calibration` returned.

    In a folder the file for NAME.jpg is NAME.camera.json or NAME.json; return None if there is none. For a
    photo that a model does not name, all cameras of the model are returned, as a choice.
    """
    if not isinstance(opened, Path):
        return opened
    if opened.is_dir():
        files = [opened / f"{pano.stem}{suffix}" for suffix in (".camera.json", ".json")]
        file = next((file for file in files if file.is_file()), None)
        return None if file is None else read_calibration(file)
    calibration, named = _read_model(opened, opened.stat().st_mtime_ns)
    (mount,) = match_names(opened, named, [pano], "cameras")
    if mount is None:
        return replace(calibration, path=f"{opened}, whose images do not name the photo")
    return replace(calibration, mounts=(mount,))


def find_images(cameras: Path) -> Path | None:
    """Return the file that names each photo's camera: COLMAP's images, or OpenSfM's file itself."""
    if cameras.suffix.lower() == ".json":
        return cameras if is_reconstruction(read_json(cameras, WANTED)) else None
    names = (f"images{suffix}" for suffix in (cameras.suffix, ".bin", ".txt"))
    return next((file for name in names if (file := cameras.with_name(name)).is_file()), None)


@lru_cache(2)
def _read_model(path: Path, _changed: int) -> tuple[Calibration, list[tuple[str, Mount]]]:
    """Return a model's cameras, and pairs of a photo's name and camera; `_changed` is for the cache."""
    images = find_images(path) or path
    with naming(images, WANTED):
        if images == path:
            document = read_json(path, WANTED)
            cameras = opensfm_cameras(document)
            shots = [shot for part in document for shot in part["shots"].items()]
            named = [(str(name), cameras[shot["camera"]]) for name, shot in shots]
        else:
            cameras = read_colmap_cameras(path)
            named = [(name, cameras[camera]) for *_, camera, name in read_images(images, WANTED)]
    return read_calibration(path), named
