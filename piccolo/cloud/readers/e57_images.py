"""The images inside an E57 file: what there is, and the JPEG or PNG of each."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from ...errors import InputError
from ...geometry.pose import Pose
from .e57_file import (
    E57File,
    child,
    children,
    number_of,
    opened,
    parsed_integer,
    pose_of,
    refusing,
    text_of,
)

KINDS = {
    "spherical": "sphericalRepresentation",
    "pinhole": "pinholeRepresentation",
    "cylindrical": "cylindricalRepresentation",
    "visual-reference": "visualReferenceRepresentation",
}
ENCODINGS = {"jpeg": "jpegImage", "png": "pngImage"}
BEGINNINGS = {"jpeg": b"\xff\xd8\xff", "png": b"\x89PNG\r\n\x1a\n"}
MAX_SIDE = 1 << 20  # [px]


@dataclass(frozen=True)
class E57Image:
    """One representation of one image of a file."""

    name: str
    kind: str  # of KINDS
    encoding: str  # of ENCODINGS
    size: int  # [byte]
    width: int  # [px]
    height: int  # [px]
    fov_deg: tuple[float, float] | None  # of a spherical image, across and down
    pose: Pose | None
    scan_guid: str  # of the scan it belongs to, or empty
    node: tuple[int, str, str]  # index in images2D, names of the representation and the blob


def list_images(path: Path) -> list[E57Image]:
    """The images of an E57 file, in its order."""
    with opened(path) as file:
        return _listed(file)


def read_image(path: Path, index: int) -> bytes:
    """The JPEG or PNG file that is the image of that index in list_images."""
    with opened(path) as file:
        image = _listed(file)[index]
        number, representation, blob = image.node
        with refusing(path, file.libe57):
            content = file.image_file.root()["images2D"][number][representation][blob].read_buffer().tobytes()
    if not content.startswith(BEGINNINGS[image.encoding]):
        raise InputError(f"{path}: image {index} begins with {content[:8]!r}, wanted a {image.encoding} file")
    return bytes(content)


def _listed(file: E57File) -> list[E57Image]:
    elements = enumerate(children(file.root, "images2D"))
    return [image for number, element in elements for image in _images(file, number, element)]


def _images(file: E57File, number: int, element: Element) -> Iterator[E57Image]:
    """The representations of an element of images2D that hold an image."""
    for kind, representation_name in KINDS.items():
        representation = child(element, representation_name)
        for encoding, blob_name in ENCODINGS.items():
            blob = child(representation, blob_name)
            if representation is None or blob is None or blob.get("type") != "Blob":
                continue
            yield E57Image(
                name=text_of(element, "name"),
                kind=kind,
                encoding=encoding,
                size=_blob_size(file, number, blob),
                width=_side(file.path, representation, "imageWidth"),
                height=_side(file.path, representation, "imageHeight"),
                fov_deg=_fov_deg(file.path, representation) if kind == "spherical" else None,
                pose=pose_of(file.path, element),
                scan_guid=text_of(element, "associatedData3DGuid"),
                node=(number, representation_name, blob_name),
            )


def _blob_size(file: E57File, number: int, blob: Element) -> int:
    """The length [byte] of a blob, if the file has room for it: libE57 reserves it."""
    size = parsed_integer(file.path, blob.get("length", ""))
    if not 0 < size <= file.size:
        found = f"promises {size} bytes, found a file of {file.size} bytes"
        raise InputError(f"{file.path}: image {number} {found}; it is broken")
    return size


def _side(path: Path, representation: Element, name: str) -> int:
    value = number_of(path, child(representation, name)) or 0.0
    if not 0 < value <= MAX_SIDE:
        raise InputError(f"{path}: an image's {name} is {value:g}, wanted 1 to {MAX_SIDE}")
    return int(value)


def _fov_deg(path: Path, representation: Element) -> tuple[float, float] | None:
    """What a spherical image covers [deg], across and down, if the file says how large its pixels are."""
    width, height = (number_of(path, child(representation, name)) for name in ("pixelWidth", "pixelHeight"))
    if width is None or height is None:
        return None
    across = width * _side(path, representation, "imageWidth")
    down = height * _side(path, representation, "imageHeight")
    return math.degrees(across), math.degrees(down)
