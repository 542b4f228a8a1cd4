"""Parts of E57 files that scans and images share: header, XML section, numbers, poses.

The XML is parsed here, within limits, before libE57 opens the file: libE57's parser would load other files
that a document type definition or a schema names, and has no limit on the depth and number of elements.
"""

import math
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

import numpy as np

from ...geometry.pose import Pose, rotation_from_quaternion_wxyz
from ...system.arrays import Array
from ...system.errors import InputError, import_optional
from .reader import quote_line

MAGIC = b"ASTM-E57"
HEADER = struct.Struct("<8sIIQQQQ")  # magic, major, minor, file size, XML offset, XML size, page size
PAGE_SIZE = 1024  # [byte]
PAGE_CONTENT = 1020  # [byte] of a page; the rest is its checksum
NAMESPACE = "{http://www.astm.org/COMMIT/E57/2010-e57-v1.0}"
MAX_XML_SIZE = 1 << 26  # [byte]
# libE57's time grows with the square of the elements in a structure; vectors hold scans and images
MAX_ELEMENTS = 500_000
MAX_XML_PARTS = 500
MAX_IN_VECTOR = 20_000
MAX_XML_DEPTH = 32
INTEGER = re.compile(r"[+-]?[0-9]{1,19}")
CHECK_ALL = 100  # [%] of the pages whose checksums libE57 verifies


class E57File(NamedTuple):
    """An E57 file opened by libE57, and its XML."""

    path: Path
    size: int  # [byte]
    root: Element  # of the XML
    libe57: ModuleType
    image_file: Any  # libE57's object of the open file


@contextmanager
def open_file(path: Path) -> Iterator[E57File]:
    """Check the header and XML of an E57 file, and yield it open for reading."""
    root = read_e57_xml(path)
    libe57 = import_optional(path, "pye57.libe57")
    with refusing(path, libe57):
        image_file = libe57.ImageFile(str(path), "r", CHECK_ALL)
    try:
        yield E57File(path, path.stat().st_size, root, libe57, image_file)
    finally:
        image_file.close()


@contextmanager
def refusing(path: Path, libe57: ModuleType) -> Iterator[None]:
    """Turn libE57's errors on a broken file into an InputError."""
    try:
        yield
    except (libe57.E57Exception, RuntimeError, UnicodeDecodeError) as error:  # the last: a bad message
        raise InputError(f"{path}: broken E57 file ({quote_line(str(error).encode())})") from error


def read_e57_xml(path: Path) -> Element:
    """Return the root of a file's XML section."""
    return _parse_xml(path, read_section(path))


def read_e57_crs(path: Path) -> str:
    """Return the coordinate system that a file names; empty if it names none."""
    return read_e57_xml(path).findtext("coordinateMetadata", "")


def read_section(path: Path) -> bytes:
    """Return a file's XML section, without checksums. Raise InputError if the header is damaged."""
    with path.open("rb") as file:
        head = file.read(HEADER.size)
        if len(head) < HEADER.size or not head.startswith(MAGIC):
            raise InputError(f"{path}: begins with {head[:8]!r} and {len(head)} bytes, wanted 'ASTM-E57'")
        _, major, _, size, offset, length, page_size = HEADER.unpack(head)
        found = path.stat().st_size
        text = f"{path}: the header promises"
        if major != 1 or page_size != PAGE_SIZE:
            raise InputError(f"{path}: E57 {major} in pages of {page_size} bytes, wanted 1 and {PAGE_SIZE}")
        if size != found or found % PAGE_SIZE:
            raise InputError(f"{text} {size} bytes, found {found}; the file is cut off or broken")
        num_bytes = (offset % PAGE_SIZE + length) // PAGE_CONTENT * PAGE_SIZE + PAGE_SIZE
        if length > MAX_XML_SIZE or offset + length > found:
            most = f"wanted {MAX_XML_SIZE} at most and within the file's {found} bytes"
            raise InputError(f"{text} {length} bytes of XML from byte {offset} on, {most}")
        file.seek(offset - offset % PAGE_SIZE)
        pages = file.read(num_bytes)
    content = b"".join(pages[k : k + PAGE_CONTENT] for k in range(0, len(pages), PAGE_SIZE))
    return content[offset % PAGE_SIZE :][:length].rstrip(b"\0")


class _Limited(TreeBuilder):
    """A builder of the element tree that keeps to limits and refuses references to other files."""

    def __init__(self) -> None:
        super().__init__()
        self.num_elements = 0
        self.room = [1]  # how many more children each open element may have

    def start(self, tag: str, attrs: dict[str, str]) -> Element:
        """Open an element."""
        self.num_elements += 1
        self.room[-1] -= 1
        if self.num_elements > MAX_ELEMENTS or len(self.room) > MAX_XML_DEPTH:
            raise ValueError(f"more than {MAX_ELEMENTS} elements or {MAX_XML_DEPTH} levels")
        if self.room[-1] < 0:
            most = f"{MAX_XML_PARTS} elements in a structure or {MAX_IN_VECTOR} in a vector"
            raise ValueError(f"more than {most}")
        self.room.append(MAX_IN_VECTOR if attrs.get("type") == "Vector" else MAX_XML_PARTS)
        if any(name.lower().endswith("schemalocation") for name in attrs):
            raise ValueError("a schema in another file")
        return super().start(tag.removeprefix(NAMESPACE), attrs)

    def end(self, tag: str) -> Element:
        """Close an element."""
        self.room.pop()
        return super().end(tag.removeprefix(NAMESPACE))

    def doctype(self, *_: str | None) -> None:
        """Refuse a document type definition, which could declare entities."""
        raise ValueError("a document type definition")


def _parse_xml(path: Path, xml: bytes) -> Element:
    parser = XMLParser(target=_Limited())
    try:
        parser.feed(xml)
        root = parser.close()
    except (ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path}: the XML section is broken ({quote_line(str(error).encode())})") from error
    if not isinstance(root, Element) or root.tag != "e57Root":
        raise InputError(f"{path}: the XML section has no element e57Root of E57 1.0")
    return root


def read_number(path: Path, element: Element, place: str) -> float | None:
    """Return the number in the element at a path below another: 0 if that is empty, None if it is missing."""
    found = element.find(place)
    return None if found is None else read_scaled(path, found, (found.text or "").strip() or "0")


def read_scaled(path: Path, element: Element, text: str) -> float:
    """Return the number in an element's text, scaled if the element is a ScaledInteger."""
    value = parse_number(path, text)
    if element.get("type") != "ScaledInteger":
        return value
    scale = parse_number(path, element.get("scale", "1"))
    return value * scale + parse_number(path, element.get("offset", "0"))


def parse_number(path: Path, text: str) -> float:
    """Parse a finite number. Raise InputError if the text is none."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        found = quote_line(text.encode())
        raise InputError(f"{path}: found {found} in the XML section, wanted a finite number")
    return value


def parse_integer(path: Path, text: str) -> int:
    """Parse an integer of at most 19 digits. Raise InputError if the text is none."""
    if not INTEGER.fullmatch(text):
        raise InputError(f"{path}: found {quote_line(text.encode())} in the XML section, wanted an integer")
    return int(text)


def pose_of(path: Path, element: Element) -> Pose | None:
    """Return the pose of a scan or an image, or None. A missing rotation or translation is the identity's."""
    if element.find("pose") is None:
        return None
    q = np.eye(4)[0]
    if element.find("pose/rotation") is not None:
        q = _numbers(path, element, "pose/rotation", "wxyz")
    if not 0.0 < np.linalg.norm(q) < math.inf:
        raise InputError(f"{path}: a pose's rotation is {q.tolist()}, wanted a quaternion w x y z")
    return Pose(rotation_from_quaternion_wxyz(q).T, _numbers(path, element, "pose/translation", "xyz"))


def _numbers(path: Path, element: Element, place: str, names: str) -> Array:
    return np.array([read_number(path, element, f"{place}/{name}") or 0.0 for name in names])
