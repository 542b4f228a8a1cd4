"""Reading of panoramas: picture files, folders of cube faces and arrays become full spheres with masks."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ...system.arrays import Bytes, Mask
from ...system.errors import InputError
from ...system.jobs.memory import check_memory
from ..camera import Calibration, Mount
from ..camera.calibration import MAX_OFFSET
from ..camera.resampling import CameraView, make_sphere, sphere_width
from ..photo import File, Photo, as_photo
from . import gpano
from .cameras import Cameras, cameras_of, read_views, rig_cameras
from .cube import cube_of_cells, face_paths, read_cube_folder
from .facts import elevation_deg
from .gpano import ASPECT_TOLERANCE, CropRegion
from .masks import black_borders, find_mask, is_dual_fisheye, mask_pole, polar_disc, read_mask, shows_twice
from .panorama import FocalPrior, GPano, Panorama
from .picture import PICTURE_BYTES_PER_PIXEL, Picture, picture_shape, read_picture

Shot = tuple[Path, Picture, tuple[Mount, ...]]  # a file, its picture, and the cameras that took it
PHOTO_FOV_DEG = 65, 50  # width by a phone's main camera (24 to 28 mm): 63 to 72, if held upright 50 to 57
CHOICES = (
    "If a camera took it, give `focal_px` or `camera`; if its focal length is unknown, `projection` pinhole "
    "`fov_deg` {} `refine_focal`. If it is a part of a panorama, give `fov_deg`. If it is a cube, give "
    "a folder of its six faces (in Python also `cube_order`)"
)
CAMERA_RATIOS = 4 / 3, 3 / 2, 16 / 9
LIKE_A_PHOTO = (
    "read as a part of a panorama, though it has the shape of a camera's photo: for a photo add `projection` "
    "pinhole, for a part of a panorama `projection` equirectangular"
)
NO_HORIZON = "the metadata call the crop's height the sphere's: its horizon is assumed to be in the middle"
MIN_REPORTED_SHARE = 0.001  # of the sphere: smaller borders are masked without a warning


def read_panorama(photo: File | Bytes | Photo) -> Panorama:
    """Return the full sphere of a picture file, a folder of six cube faces or an array.

    Colours have 8 bits (of 16 the upper 8, v >> 8), grey becomes RGB, EXIF's orientation is applied. Pixels
    are not valid if they have alpha 0, are outside of a crop, are masked, or lie in a black border or a disc
    over a pole. In an array only masked pixels are not valid.

    Raise InputError if the file is missing or damaged, has another format or projection, if its size is out
    of range, or if it is unknown what part of the sphere it shows.
    """
    photo = as_photo(photo)
    panorama = _read(photo)
    if photo.gravity_vector is None:
        return panorama
    return replace(panorama, gpano=gpano.attitude_of_gravity(photo.gravity_vector))


def _read(photo: Photo) -> Panorama:
    """Read a photo with the attitude that its file gives."""
    if isinstance(photo.picture, np.ndarray):
        return _read_array(photo, photo.picture)
    if photo.instant is not None:
        return _read_rig(photo, photo.instant)
    if photo.path.is_dir():
        return _embed_and_mask(photo, read_cube_folder(photo.path), CropRegion(), None)
    return _read_picture(photo)


def _read_picture(photo: Photo) -> Panorama:
    """Read the photo in one file."""
    path = photo.path
    picture = read_picture(path)
    if photo.projection == "cylindrical" and photo.fov_deg is not None:
        picture = _unroll(picture, math.radians(photo.fov_deg))
    if cube := cube_of_cells(path, picture, photo.cube_order):
        return _embed_and_mask(photo, cube, CropRegion(), None)
    fields = gpano.gpano_fields(picture.xmp)
    cameras = cameras_of(photo, picture, bool(fields))
    attitude = gpano.attitude(fields) if fields else None
    picture = replace(picture, warnings=(*picture.warnings, *cameras.notes))
    if cameras.mounts:
        if attitude is None and (elevation := elevation_deg(picture.exif)) is not None:
            attitude = GPano(elevation)
        return _on_sphere(photo, [(path, picture, cameras.mounts)], attitude, cameras)
    region, more = _region_of(photo, picture, fields)
    picture = replace(picture, warnings=(*picture.warnings, *more))
    return _embed_and_mask(photo, picture, region, attitude)


def _read_array(photo: Photo, rgb: Bytes) -> Panorama:
    """Return the panorama of an array (H, W, 3): a full sphere, or the picture of the photo's camera."""
    rgb = np.ascontiguousarray(rgb)
    is_valid = ~photo.mask if isinstance(photo.mask, np.ndarray) else np.ones(rgb.shape[:2], np.bool_)
    picture = Picture(rgb, is_valid)
    cameras = cameras_of(photo, picture, has_gpano=True)
    if cameras.mounts:
        return _on_sphere(photo, [(photo.path, picture, cameras.mounts)], None, cameras)
    if rgb.shape[1] != 2 * len(rgb):
        found = f"{rgb.dtype} of shape {rgb.shape}"
        raise InputError(f"`picture`: found {found}, wanted RGB in uint8 of shape (H, 2 H, 3), or a camera")
    return Panorama(rgb, is_valid)


def _read_rig(photo: Photo, rig: Calibration) -> Panorama:
    """Return the panorama of a rig's pictures of one instant."""
    folder = photo.path
    files = rig.images_in(folder)
    pictures = [read_picture(file) for file in files]
    shots = list(zip(files, pictures, rig_cameras(folder, pictures, rig), strict=True))
    panorama = _on_sphere(photo, shots, None)
    if rig.extent <= MAX_OFFSET:
        return panorama
    note = f"the rig's cameras are up to {rig.extent:.2f} m from its origin: near objects appear displaced"
    return replace(panorama, warnings=(*panorama.warnings, note))


def _on_sphere(
    photo: Photo, shots: list[Shot], attitude: GPano | None, of_one: Cameras | None = None
) -> Panorama:
    """Resample the pictures of one instant, each with its file and cameras, to one sphere; apply masks.

    `of_one`, for a single picture, has the standard deviation and the source of the focal length.
    """
    cameras = tuple(mount for *_, mounts in shots for mount in mounts)
    width = sphere_width(cameras)
    num_bytes = width * width // 2 * PICTURE_BYTES_PER_PIXEL
    check_memory(num_bytes, f"{photo.path}: the sphere of {width} x {width // 2}", "make the picture smaller")
    views: list[CameraView] = []
    notes: list[str] = []
    sphere_mask = None
    for file, picture, mounts in shots:
        masks = _user_masks(file, [picture.size, (width, width // 2)], photo, notes)
        if 1 in masks:
            sphere_mask = masks[1] if sphere_mask is None else sphere_mask & masks[1]
        is_valid = picture.is_valid & masks[0] if 0 in masks else picture.is_valid
        own, more = read_views(file, picture, mounts, is_valid)
        views += own
        notes += [*picture.warnings, *more]
    rgb, is_valid = make_sphere(views, width)
    panorama = Panorama(rgb, is_valid, attitude, tuple(dict.fromkeys(notes)), cameras)
    masked = _mask(photo, panorama, sphere_mask)
    if of_one is None or len(cameras) > 1:
        return masked
    is_hidden = is_valid & ~masked.is_valid
    if not is_hidden.any():
        is_hidden = np.zeros(is_valid.shape, np.bool_)  # zeros mostly take no memory
    focal = cameras[0].camera.focal[0]
    prior = FocalPrior(focal, of_one.deviation, of_one.source, views[0], is_hidden)
    return replace(masked, focal_prior=prior)


def panorama_size(path: Path) -> tuple[int, int]:
    """Return width and height [px] of a file's panorama, not decoded. Raise InputError if EXIF turns it."""
    size, orientation = picture_shape(face_paths(path)["f"] if path.is_dir() else path)
    if path.is_dir():
        return 4 * size[0], 2 * size[0]
    if orientation not in (None, 1):
        turned = f"found it stored rotated (EXIF orientation {orientation})"
        raise InputError(f"{path}: {turned}, wanted it upright")
    return size


def _region_of(photo: Photo, picture: Picture, fields: dict[str, str]) -> tuple[CropRegion, list[str]]:
    """Return the part of the sphere that a picture shows, by the options or metadata, and warnings."""
    width, height = picture.size
    if photo.fov_deg is not None:
        notes = [LIKE_A_PHOTO] if photo.projection is None and not fields and _is_like_photo(picture) else []
        return gpano.region_of_fov(photo.fov_deg, width, height), notes
    name = fields.get("ProjectionType", "").lower()
    if name not in ("", "equirectangular"):
        wanted = "wanted equirectangular, or of a cylinder `projection` cylindrical and `fov_deg`"
        raise InputError(f"{photo.path}: its metadata names the projection {name!r}, {wanted}")
    if width == height and shows_twice(picture.rgb, 0):
        raise InputError(f"{photo.path}: two panoramas above each other, one for each eye, wanted one")
    notes = [NO_HORIZON] if gpano.lacks_horizon(fields) else []
    region = gpano.crop_region(fields, width / height)
    is_two_to_one = abs(width - 2 * height) <= ASPECT_TOLERANCE * 2 * height
    missing = [name for name in gpano.CROP_FIELDS if fields and name not in fields]
    if region is None and is_two_to_one:
        region = CropRegion()
        notes = ["the crop in the metadata is invalid or has another shape; read as a full sphere"]
    if region is None or (region.is_full and not is_two_to_one):
        wrong = "no field of view is given" if photo.projection else "no focal length in EXIF"
        wrong = "a crop in the metadata that does not fit it" if region is None else wrong
        wrong = f"a crop in the metadata without {missing[-1]}" if missing else wrong
        found = f"found a picture of {width} x {height}, which is no full panorama (2:1), and {wrong}"
        raise InputError(f"{photo.path}: {found}. {CHOICES.format(PHOTO_FOV_DEG[width < height])}")
    if region.is_full and is_dual_fisheye(picture.rgb):
        found = "two fisheye pictures side by side, wanted their calibration as `camera` (docs/CAMERAS.md)"
        raise InputError(f"{photo.path}: {found}, or a panorama that the camera's program has stitched")
    if region.is_full and shows_twice(picture.rgb, 1):
        found = "two half spheres side by side, one for each eye (VR180)"
        raise InputError(f"{photo.path}: {found}, wanted a full sphere, or one of them as a fisheye photo")
    return region, notes


def _unroll(picture: Picture, angle: float) -> Picture:
    """Return the picture of a cylinder, `angle` [rad] wide, resampled as a strip of the sphere."""
    width, height = picture.size
    radius = width / angle  # [px]
    half = math.atan(height / 2.0 / radius)
    elevations = half - (np.arange(max(round(2.0 * half * radius), 1)) + 0.5) / radius
    rows = (height / 2.0 - radius * np.tan(elevations) - 0.5).astype(np.float32)
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), rows)
    rgb = cv2.remap(picture.rgb, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    counts = cv2.remap(picture.is_valid.astype(np.uint8), u, v, cv2.INTER_NEAREST)
    return replace(picture, rgb=np.asarray(rgb, np.uint8), is_valid=np.asarray(counts > 0))


def _is_like_photo(picture: Picture) -> bool:
    """Return True if a picture has the shape of a camera's photos, upright or not."""
    ratio = max(picture.size) / min(picture.size)
    return any(abs(ratio / camera_ratio - 1.0) <= ASPECT_TOLERANCE for camera_ratio in CAMERA_RATIOS)


def _embed_and_mask(photo: Photo, picture: Picture, region: CropRegion, attitude: GPano | None) -> Panorama:
    """Embed the picture in the full sphere, and mask borders, patches and what the user masks."""
    path = photo.path
    size = gpano.full_size(path, region, picture.size)
    notes = [*picture.warnings]
    masks = _user_masks(path, [size, picture.size], photo, notes)
    is_valid = picture.is_valid & masks[1] if 1 in masks else picture.is_valid
    borders = black_borders(picture.rgb, is_valid, region.is_full)
    if borders is not None:
        is_valid = is_valid & ~borders
        fraction = _sphere_fraction(borders, region)
        if fraction >= MIN_REPORTED_SHARE:
            notes.append(f"masked black borders: {100 * fraction:.1f} % of the sphere")
    rgb, is_valid = gpano.embed_crop(path, picture.rgb, is_valid, region)
    for pole in ("zenith", "nadir"):
        half_angle = polar_disc(rgb, is_valid, pole)
        if half_angle:
            notes.append(f"masked a {pole} patch of {half_angle:.1f} deg")
            is_valid = mask_pole(is_valid, pole, half_angle)
    return _mask(photo, Panorama(rgb, is_valid, attitude, tuple(notes)), masks.get(0))


def _mask(photo: Photo, panorama: Panorama, sphere_mask: Mask | None) -> Panorama:
    """Return the panorama without the pixels that a mask of its size, or `mask_nadir_deg`, excludes."""
    is_valid = panorama.is_valid if sphere_mask is None else panorama.is_valid & sphere_mask
    is_valid = mask_pole(is_valid, "nadir", photo.mask_nadir_deg)
    if not is_valid.any():
        raise InputError(f"{photo.path}: no pixel is left: all are masked or black")
    return replace(panorama, is_valid=np.ascontiguousarray(is_valid))


def _user_masks(path: Path, sizes: list[tuple[int, int]], photo: Photo, notes: list[str]) -> dict[int, Mask]:
    """Return the user's mask, True for valid pixels, by the index of the size whose shape it has."""
    if photo.mask is None or isinstance(photo.mask, np.ndarray):
        return {}
    file = find_mask(Path(photo.mask), path)
    if file is None:
        notes.append(f"found no mask {path.stem} in {photo.mask}")
        return {}
    is_folder = Path(photo.mask).is_dir()
    if is_black_ignored := is_folder and file.stem != path.stem:  # it is named as by COLMAP or Metashape
        notes.append(f"of the mask {file.name}, black is ignored, as COLMAP and Metashape have it")
    index, mask = read_mask(file, sizes, is_black_ignored)
    return {index: mask}


def _sphere_fraction(is_there: Mask, region: CropRegion) -> float:
    """Return the fraction of the sphere that a mask (H, W) of a picture of `region` covers."""
    rows = (np.arange(len(is_there)) + 0.5) / len(is_there) * region.height + region.top
    per_row = is_there.mean(axis=1) * np.sin(np.clip(rows, 0.0, 1.0) * np.pi)
    return float(per_row.mean() * region.width * region.height * np.pi / 2.0)
