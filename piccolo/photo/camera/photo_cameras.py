"""Calibrations of single photos: a file for each in a folder, or a model that says which camera took which.

Models are COLMAP's cameras with its images beside, and OpenSfM's reconstruction.json.
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from ...system.files.json_file import naming, read_json
from ...system.files.photo_names import match_names
from .calibration import WANTED, Calibration, Mount, opensfm_cameras, read_calibration, read_colmap_cameras
from .foreign import is_reconstruction, read_images


def open_calibration(path: Path) -> Calibration | Path:
    """Return the cameras in a file, as `read_calibration`; the path where `find_calibration` has to look."""
    if path.is_dir():
        return path.absolute()
    calibration = read_calibration(path)
    is_model = calibration.is_choice and len(calibration.mounts) > 1 and find_images(path) is not None
    return path.absolute() if is_model else calibration


def find_calibration(given: Calibration | Path | None, pano: Path) -> Calibration | None:
    """Return a photo's calibration by what `open_calibration` returned; None if a folder has no file of it.

    In a folder the photo NAME.jpg has NAME.camera.json or NAME.json. A model's cameras are all left to a
    photo that it does not name.
    """
    if not isinstance(given, Path):
        return given
    if given.is_dir():
        files = [given / f"{pano.stem}{suffix}" for suffix in (".camera.json", ".json")]
        file = next((file for file in files if file.is_file()), None)
        return None if file is None else read_calibration(file)
    calibration, named = _read_model(given, given.stat().st_mtime_ns)
    (mount,) = match_names(given, named, [pano], "cameras")
    if mount is None:
        return replace(calibration, path=f"{given}, whose images do not name the photo")
    return replace(calibration, mounts=(mount,))


def find_images(cameras: Path) -> Path | None:
    """Return the file that says which of some cameras took which photo: COLMAP's images, or itself."""
    if cameras.suffix.lower() == ".json":
        return cameras if is_reconstruction(read_json(cameras, WANTED)) else None
    names = (f"images{suffix}" for suffix in (cameras.suffix, ".bin", ".txt"))
    return next((file for name in names if (file := cameras.with_name(name)).is_file()), None)


@lru_cache(2)
def _read_model(path: Path, _changed: int) -> tuple[Calibration, list[tuple[str, Mount]]]:
    """Return a model's cameras, and those of its photos by name."""
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
