"""Copies of E57 files whose images have other poses; points, images and all else stay as they are.

The new XML section is appended, with its checksums (CRC-32C), and the header leads to it.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.dom import minidom

import numpy as np

from ..cloud.readers.e57 import E57Image, list_images
from ..cloud.readers.e57_file import HEADER, NAMESPACE, PAGE_CONTENT, PAGE_SIZE, read_section
from ..geometry.pose import OPENGL_FROM_CAM, Pose, quaternion_wxyz, turn_axes
from ..system.arrays import Bytes
from ..system.files.atomic import replacing

ROTATION = "".join(f'<{k} type="Float">%r</{k}>' for k in "wxyz")
TRANSLATION = "".join(f'<{k} type="Float">%r</{k}>' for k in "xyz")
POSE = f"""<pose type="Structure"><rotation type="Structure">{ROTATION}</rotation>
<translation type="Structure">{TRANSLATION}</translation></pose>"""
# a sphere's middle is its +x, a pinhole looks along -z (ASTM E2807)
IMAGE_FROM_CAM = {"spherical": np.eye(3), "pinhole": OPENGL_FROM_CAM}
POLYNOMIAL = 0x82F63B78  # of CRC-32C, reflected


def list_posed_images(path: Path) -> list[tuple[E57Image, Pose]]:
    """Return the spheres and pinholes in an E57 file that have a pose, with it in our camera axes."""
    images = [image for image in list_images(path) if image.kind in IMAGE_FROM_CAM]
    return [(image, turn_axes(image.pose, IMAGE_FROM_CAM[image.kind].T)) for image in images if image.pose]


def write_image_poses(path: Path, out: Path, poses: Sequence[Pose]) -> None:
    """Write a copy of an E57 file with other poses of the images of `list_posed_images`, in their order."""
    images = [image for image, _ in list_posed_images(path)]
    document = minidom.parseString(read_section(path))  # a DOM keeps namespaces, prefixes and CDATA
    (vector,) = document.getElementsByTagNameNS(NAMESPACE.strip("{}"), "images2D")
    elements = [node for node in vector.childNodes if node.nodeType == node.ELEMENT_NODE]
    for image, pose in zip(images, poses, strict=True):
        element = elements[image.node[0]]
        for old in [node for node in element.childNodes if node.nodeName == "pose"]:
            element.removeChild(old)
        R_image_from_world = IMAGE_FROM_CAM[image.kind] @ pose.R_cam_from_world
        text = POSE % (*quaternion_wxyz(R_image_from_world.T).tolist(), *pose.center_world.tolist())
        new: Any = minidom.parseString(text).documentElement
        element.appendChild(document.importNode(new, True))
    xml = document.toxml(encoding="UTF-8")
    pages = _seal(xml)
    size = path.stat().st_size
    with path.open("rb") as old_file, replacing(out) as file:
        shutil.copyfileobj(old_file, file)
        file.write(pages)
        file.seek(0)
        page = bytearray(file.read(PAGE_CONTENT))
        magic, major, minor, *_, page_size = HEADER.unpack_from(page)
        HEADER.pack_into(page, 0, magic, major, minor, size + len(pages), size, len(xml), page_size)
        file.seek(0)
        file.write(_seal(bytes(page)))


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
