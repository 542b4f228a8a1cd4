"""Copies of E57 files whose images have other poses; points, images and all else stay as they are.

The new XML section is appended, with its checksums (CRC-32C), and the header leads to it.
"""

import shutil
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any
from xml.dom import minidom

import numpy as np

from ..arrays import Bytes
from ..files.atomic import replacing
from ..geometry.pose import Pose
from .readers.e57_file import HEADER, NAMESPACE, PAGE_CONTENT, PAGE_SIZE, read_section, read_xml

POLYNOMIAL = 0x82F63B78  # of CRC-32C, reflected


def write_image_poses(path: Path, out: Path, poses: Mapping[int, Pose]) -> None:
    """Write a copy of an E57 file with poses of images by their numbers in images2D, in the images' axes."""
    read_xml(path)  # refuses what no parser should read
    xml = _with_poses(read_section(path), poses)
    size = path.stat().st_size
    with path.open("rb") as old, replacing(out) as file:
        shutil.copyfileobj(old, file)
        file.write(_seal(xml))
        file.seek(0)
        page = bytearray(file.read(PAGE_CONTENT))
        magic, major, minor, *_, page_size = HEADER.unpack_from(page)
        HEADER.pack_into(page, 0, magic, major, minor, size + len(_seal(xml)), size, len(xml), page_size)
        file.seek(0)
        file.write(_seal(bytes(page)))


def _with_poses(xml: bytes, poses: Mapping[int, Pose]) -> bytes:
    """Return an XML section with other poses; a DOM keeps namespaces, prefixes and CDATA as they are."""
    document = minidom.parseString(xml)
    (images,) = document.getElementsByTagNameNS(NAMESPACE.strip("{}"), "images2D")
    elements = [node for node in images.childNodes if node.nodeType == node.ELEMENT_NODE]
    for number, pose in poses.items():
        for old in [node for node in elements[number].childNodes if node.nodeName == "pose"]:
            elements[number].removeChild(old)
        rotation = Pose(pose.R_cam_from_world.T, pose.center_world).quaternion_wxyz
        parts = {"rotation": ("wxyz", rotation), "translation": ("xyz", pose.center_world)}
        text = "".join(
            f'<{part} type="Structure">{_floats(names, values.tolist())}</{part}>'
            for part, (names, values) in parts.items()
        )
        new: Any = minidom.parseString(f'<pose type="Structure">{text}</pose>').documentElement
        elements[number].appendChild(document.importNode(new, True))
    return document.toxml(encoding="UTF-8")


def _floats(names: str, values: list[float]) -> str:
    return "".join(
        f'<{name} type="Float">{value!r}</{name}>' for name, value in zip(names, values, strict=True)
    )


def _seal(content: bytes) -> bytes:
    """Return whole pages with their checksums, the last filled with zeros."""
    filled = content + bytes(-len(content) % PAGE_CONTENT)
    pages = np.frombuffer(filled, np.uint8).reshape(-1, PAGE_CONTENT)
    crc = np.full(len(pages), 0xFFFFFFFF, np.uint32)
    for column in pages.T:
        crc = _crc_table()[(crc ^ column) & 255] ^ (crc >> np.uint32(8))
    sums: Bytes = (~crc).astype(">u4").view(np.uint8).reshape(-1, PAGE_SIZE - PAGE_CONTENT)
    return np.hstack([pages, sums]).tobytes()


@cache
def _crc_table() -> np.ndarray[tuple[int], np.dtype[np.uint32]]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = (table >> np.uint32(1)) ^ np.where(table & 1, np.uint32(POLYNOMIAL), np.uint32(0))
    return table
