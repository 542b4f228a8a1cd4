"""The pictures and poses to export, from results, and what describes a format."""

import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ...api.values import LOCALIZED, Result
from ...geometry.points import LocalCloud
from ...geometry.pose import Pose
from ...photo.camera import Calibration, Camera, Mount
from ...photo.panorama import panorama_size
from ...photo.panorama.gpano import check_size
from ...system.errors import InputError, unreadable
from ...system.files.atomic import is_stream, replacing, write_lines

NO_UTF8 = "[\ud800-\udfff]"  # in a name
# by the lens of a camera model: its name in a format, and the coefficients that it may have
Lenses = Mapping[str, tuple[str, tuple[str, ...]]]
LeftOut = dict[str, list[str]]  # names of pictures that a format can't hold, by why


class PosedImage(NamedTuple):
    """One picture with its pose, as it is to be written."""

    name: str  # of the picture, relative to the folder of images
    path: Path  # where the picture is
    time: str  # timestamp, a number as text
    pose: Pose  # less the offset
    size: tuple[int, int]  # W, H [px]; (0, 0) for a format that takes none
    result: Result
    camera: Camera | None = None  # None for a sphere
    mask: str | None = None  # in the data set, black where the picture does not count

    @property
    def lens(self) -> Camera:
        """The camera, also of a sphere."""
        width, height = self.size
        return self.camera or Camera("EQUIRECTANGULAR", width, height, (float(width), float(height)))


@dataclass(frozen=True)
class Options:
    """Choices of the user; a format takes some of these."""

    images: Path | None = None  # folder to which names are relative; None: as the result has them
    size: tuple[int, int] | None = None  # W, H [px] of all pictures; None: read from each
    offset: tuple[float, float, float] | None = None  # subtracted from positions [m]
    axes: str = "optical"  # of the camera in a trajectory: "optical" or "piccolo"
    timestamps: str = "index"  # "index"; "name": the number that is the picture's name; "walk": of its frame
    crs: str | None = None  # of the cloud's coordinates, such as EPSG:25832
    points: int | None = None  # of the scan, at most
    scan: LocalCloud | None = None  # from which these are
    faces: int | None = None  # pinhole pictures of each sphere, in a folder with the model; None: spheres
    into: Path | None = None  # folder of a model to which the images are added

    def __post_init__(self) -> None:
        if self.size is not None:
            check_size("`size`", self.size)
        if self.offset is not None and not all(math.isfinite(value) for value in self.offset):
            raise InputError(f"`offset`: found {self.offset}, wanted three finite numbers")
        if self.points is not None and self.points < 1:
            raise InputError(f"`points`: found {self.points}, wanted at least 1")
        if self.faces is not None and self.into is not None:
            raise InputError("`faces`, `into`: found both, wanted one: a model has the pictures that it has")


class Format(NamedTuple):
    """A format of poses."""

    name: str
    description: str  # what reads it, and what `out` is
    write: Callable[[Sequence[PosedImage], Path, Options], None]
    options: frozenset[str] = frozenset()  # names of the Options that it takes beside `images`
    is_folder: bool = False
    has_unique_names: bool = True  # the picture's name is the key
    forbidden: str = NO_UTF8  # regular expression of what a name can't have in it; empty for anything
    check: Callable[[PosedImage], object] | None = None  # raises InputError for a picture that it can't hold
    cameras: Literal["any", "own", "spheres"] = "any"  # of photos: no matter, an image each, or not at all
    lenses: Lenses | None = None  # those that it has; None: no matter
    data_set: tuple[str, str] = ("", "")  # of faces: path of the model, and of the folder that names begin in


class SelectedResults(NamedTuple):
    """The results to write, and how many others were left out for which reason."""

    results: tuple[Result, ...]
    left_out: dict[str, int]  # how many, by status or "without a pose"

    @property
    def clouds(self) -> Mapping[str, str]:
        """Paths of the results' clouds, in order; clouds are one if their content is."""
        return {result.source.cloud_sha256 or result.cloud_name: result.cloud_name for result in self.results}


def select_results(
    results: Sequence[Result], clouds: Sequence[str] = (), use_all: bool = False
) -> SelectedResults:
    """Return the results, of `clouds` only if given, that are localized, or all that have a pose."""
    known = {result.cloud_name for result in results}
    if missing := [cloud for cloud in clouds if cloud not in known]:
        wanted = ", ".join(sorted(known))
        raise InputError(f"`cloud`: found no result for {missing[0]}, wanted one of {wanted}")
    chosen = []
    left_out = Counter[str]()
    for result in results:
        if clouds and result.cloud_name not in clouds:
            left_out["other clouds"] += 1
        elif result.best_pose is None:
            left_out["without a pose"] += 1
        elif result.status != LOCALIZED and not use_all:
            left_out[result.status] += 1
        else:
            chosen.append(result)
    return SelectedResults(tuple(chosen), dict(left_out))


def select_images(
    results: Sequence[Result], form: Format, options: Options
) -> tuple[list[PosedImage], LeftOut]:
    """Pictures and poses by the names, times and offset that the options ask for, and what is left out.

    Raises InputError if all are left out, or a name that has to be unique is not.
    """
    posed: dict[str, PosedImage] = {}
    left_out: LeftOut = {}
    for index, result in enumerate(results):
        try:
            images = _images_of(result, index, form, options)
        except (OSError, InputError) as error:
            reason = str(unreadable(Path(result.pano), error) if isinstance(error, OSError) else error)
            reason = reason.replace(f"{result.pano}: ", "")
            left_out.setdefault(reason, []).append(result.pano)
            continue
        for image in images:
            key = image.name if form.has_unique_names else str(index)
            if key in posed:
                clouds = f"{posed[key].result.cloud_name}, {result.cloud_name}"
                raise InputError(f"{key}: has two results (clouds {clouds}); choose one with `cloud`")
            posed[key] = image
    if not posed:
        reason, names = next(iter(left_out.items()))
        raise InputError(f"{names[0]}: {reason}")
    return list(posed.values()), left_out


def _images_of(result: Result, index: int, form: Format, options: Options) -> list[PosedImage]:
    """Return the pictures of a result, each as the format can hold it; InputError if it can't hold one."""
    pose = result.best_pose
    if pose is None:
        raise InputError(f"{result.pano}: this result has no pose to write")
    pose = replace(pose, center_world=pose.center_world - np.array(options.offset or (0.0, 0.0, 0.0)))
    images = []
    for path, mount in _pictures(result, form):
        name = _name(path, options.images)
        if form.forbidden and (found := re.search(form.forbidden, name)):
            raise InputError(f"{path}: {form.name} can't read {found[0]!r} in a name: rename the picture")
        size = _size(path, options) if mount is None and "size" in form.options else (0, 0)
        image = PosedImage(name, path, _time(result, path, index, options), pose, size, result)
        if mount is not None:
            image = image._replace(pose=mount.pose(pose), camera=mount.camera)
        if form.lenses is not None:
            _check_lens(image, form.lenses, form.name)
        if form.check is not None:
            form.check(image)
        images.append(image)
    return images


def _check_lens(image: PosedImage, lenses: Lenses, name: str) -> None:
    """Refuse a lens, or coefficients of one, that a format has not."""
    lens = image.lens
    known = lenses[lens.lens][1] if lens.lens in lenses else ()
    more = [name for name, value in lens.distortion._asdict().items() if value and name not in known]
    if more or lens.lens not in lenses:
        wanted = f"wanted {' '.join(known) or 'another'} for {name}"
        raise InputError(f"{image.path}: found the model {' '.join([lens.model, *more])}, {wanted}")


def _time(result: Result, path: Path, index: int, options: Options) -> str:
    """Return the timestamp of a picture, a number as text."""
    if options.timestamps == "index":
        return str(index)
    if options.timestamps == "walk":
        if result.walk is None:
            raise InputError(f"{path}: found no frame of a walk, as `timestamps` walk needs")
        return repr(result.walk.time)
    if not re.fullmatch(r"\d+(\.\d+)?", path.stem):
        raise InputError(f"{path}: its name {path.stem!r} is no number, as `timestamps` name needs")
    return path.stem


def _pictures(result: Result, form: Format) -> list[tuple[Path, Mount | None]]:
    """Return the files of a result that a format writes, with the camera of those that are no sphere."""
    path = Path(result.pano)
    mounts = result.cameras
    if not mounts or form.cameras == "any":
        return [(path, None)]
    if form.cameras == "spheres":
        found = f"found a photo with the camera model {mounts[0].camera.model}"
        raise InputError(f"{path}: {found}, wanted a sphere for {form.name}; the format colmap has cameras")
    if mounts[0].image is not None:
        return list(zip(Calibration(str(path), mounts).images_in(path), mounts, strict=True))
    if len(mounts) > 1:
        raise InputError(f"{path}: found {len(mounts)} cameras in one picture, wanted one for {form.name}")
    return [(path, mounts[0])]


def _size(path: Path, options: Options) -> tuple[int, int]:
    """Width and height [px] of a full sphere: the option, or as the picture's file has it."""
    try:
        size = options.size or panorama_size(path)
    except InputError as error:
        raise InputError(f"{error}; with `size` W H no picture is needed") from error
    check_size(str(path), size)
    return size


def names_within(images: Sequence[PosedImage], has_names: bool) -> list[str]:
    """Return names for copies of the pictures: those they have, or without `has_names` their last parts."""
    names = [image.name if has_names else Path(image.name).name for image in images]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{twice}: two pictures have this name; use `images` FOLDER to distinguish them")
    return names


def _name(pano: Path, images: Path | None) -> str:
    """Return the picture's name, with slashes, in the folder of images if there is one."""
    if images is None:
        return pano.as_posix()
    name = Path(os.path.relpath(pano, images))
    if ".." in name.parts:
        raise InputError(f"{pano}: is not in the folder `images` {images}")
    return name.as_posix()


def numbers(values: Iterable[float], separator: str = " ") -> str:
    """Return the shortest text of each number that reads back as the same float64."""
    return separator.join(repr(float(value)) for value in values)


def offset_comment(options: Options) -> list[str]:
    """Return a comment line that gives the offset; none without."""
    if options.offset is None:
        return []
    return [f"# world position = position here + {numbers(options.offset)}"]


def offset_file(out: Path) -> Path:
    """Return the file of the offset beside one that has no place for it."""
    return out.with_name(f"{out.name}.offset.txt")


def write_with_offset(out: Path, text: str, options: Options) -> None:
    """Write a file with the offset beside it: where one can't be written, both stay as they were."""
    with replacing(out) as file:
        file.write(text.encode())
        file.flush()  # a full disk is found here
        write_offset_beside(out, options)


def write_offset_beside(out: Path, options: Options) -> None:
    """Write <name>.offset.txt with the offset's three numbers, if there is an offset."""
    if options.offset is None:
        return
    if is_stream(out):
        raise InputError(f"`offset`: nothing can be written beside {out}, wanted a file as `out`")
    write_lines(offset_file(out), [*offset_comment(options), numbers(options.offset)])
