"""Copies of E57 files whose images have other poses; points, images and all else stay as they are.

The new XML section is appended, with its checksums (CRC-32C), and the header leads to it.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.dom import minidom

import numpy as np

from ..arrays import Bytes
from ..files.atomic import replacing
from ..geometry.pose import Pose, quaternion_wxyz
from .readers.e57_file import HEADER, NAMESPACE, PAGE_CONTENT, PAGE_SIZE, read_section, read_xml

ROTATION, TRANSLATION = ("".join(f'<{k} type="Float">%r</{k}>' for k in names) for names in ("wxyz", "xyz"))
POSE = f"""<pose type="Structure"><rotation type="Structure">{ROTATION}</rotation>
<translation type="Structure">{TRANSLATION}</translation></pose>"""
POLYNOMIAL = 0x82F63B78  # of CRC-32C, reflected


def write_image_poses(path: Path, out: Path, poses: Mapping[int, Pose]) -> None:
    """Write a copy of an E57 file with poses of images by their numbers in images2D, in the images' axes."""
    read_xml(path)  # refuses what no parser should read
    xml = _with_poses(read_section(path), poses)
    pages = _seal(xml)
    size = path.stat().st_size
    with path.open("rb") as old, replacing(out) as file:
        shutil.copyfileobj(old, file)
        file.write(pages)
        file.seek(0)
        page = bytearray(file.read(PAGE_CONTENT))
        magic, major, minor, *_, page_size = HEADER.unpack_from(page)
        HEADER.pack_into(page, 0, magic, major, minor, size + len(pages), size, len(xml), page_size)
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
        text = POSE % (*quaternion_wxyz(pose.R_cam_from_world.T).tolist(), *pose.center_world.tolist())
        new: Any = minidom.parseString(text).documentElement
        elements[number].appendChild(document.importNode(new, True))
    return document.toxml(encoding="UTF-8")


def _seal(content: bytes) -> bytes:
    """Return whole pages with their checksums, the last filled with zeros."""
    pages = np.frombuffer(content + bytes(-len(content) % PAGE_CONTENT), np.uint8).reshape(-1, PAGE_CONTENT)
    crc = np.full(len(pages), 0xFFFFFFFF, np.uint32)
    for column in pages.T:
        crc ^= column
        for _ in range(8):
            crc = (crc >> np.uint32(1)) ^ (crc & np.uint32(1)) * np.uint32(POLYNOMIAL)
    sums: Bytes = (~crc).astype(">u4").view(np.uint8).reshape(-1, PAGE_SIZE - PAGE_CONTENT)
    return np.hstack([pages, sums]).tobytes()
