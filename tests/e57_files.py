"""E57 files for tests, written by libE57's low-level interface."""

import struct
from dataclasses import dataclass, field

import numpy as np
from pye57 import libe57

NORMALS = ("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt")


@dataclass
class ScanToWrite:
    """Columns by name, and how to declare them."""

    columns: dict[str, np.ndarray]
    declared: dict[str, tuple] = field(default_factory=dict)  # low, high, maybe scale
    limits: dict[str, float] | None = None  # of colorLimits
    rotation_wxyz: tuple | None = None
    center_world: tuple | None = None
    name: str = "a scan"


@dataclass
class ImageToWrite:
    content: bytes
    kind: str = "sphericalRepresentation"
    blob: str = "jpegImage"
    numbers: dict[str, float] = field(default_factory=dict)
    rotation_wxyz: tuple | None = None
    center_world: tuple | None = None
    scan_guid: str = ""
    name: str = "an image"


def write(path, scans=(), images=(), crs=""):
    file = libe57.ImageFile(str(path), "w")
    file.extensionsAdd("", libe57.E57_V1_0_URI)
    file.extensionsAdd(*NORMALS)
    root = file.root()
    root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
    if crs:
        root.set("coordinateMetadata", libe57.StringNode(file, crs))
    for name in ("data3D", "images2D"):
        root.set(name, libe57.VectorNode(file, True))
    for scan in scans:
        _write_scan(file, root["data3D"], scan)
    for image in images:
        _write_image(file, root["images2D"], image)
    file.close()
    return path


def _structure(file, numbers):
    node = libe57.StructureNode(file)
    for name, value in numbers.items():
        kind = libe57.IntegerNode if isinstance(value, int) else libe57.FloatNode
        node.set(name, kind(file, value))
    return node


def _set_pose(file, node, thing):
    if thing.rotation_wxyz is None and thing.center_world is None:
        return
    pose = libe57.StructureNode(file)
    if thing.rotation_wxyz is not None:
        rotation = dict(zip("wxyz", map(float, thing.rotation_wxyz), strict=True))
        pose.set("rotation", _structure(file, rotation))
    if thing.center_world is not None:
        center = dict(zip("xyz", map(float, thing.center_world), strict=True))
        pose.set("translation", _structure(file, center))
    node.set("pose", pose)


def _declaration(file, column, declared):
    if np.issubdtype(column.dtype, np.floating):
        precision = libe57.E57_SINGLE if column.dtype == np.float32 else libe57.E57_DOUBLE
        return libe57.FloatNode(file, 0.0 if not declared else float(declared[0]), precision, *declared)
    if len(declared) == 3:
        return libe57.ScaledIntegerNode(file, declared[0], *declared, 0.0)
    return libe57.IntegerNode(file, declared[0] if declared else 0, *declared)


def _write_scan(file, data3d, scan):
    node = libe57.StructureNode(file)
    node.set("guid", libe57.StringNode(file, "{scan}"))
    node.set("name", libe57.StringNode(file, scan.name))
    _set_pose(file, node, scan)
    if scan.limits is not None:
        node.set("colorLimits", _structure(file, scan.limits))
    prototype = libe57.StructureNode(file)
    buffers = libe57.VectorSourceDestBuffer()
    kept = []
    for name, column in scan.columns.items():
        prototype.set(name, _declaration(file, column, scan.declared.get(name, ())))
        # raw values of integers, scaled or not; libE57's wrapper takes numpy's int64 for 32 bits
        kept.append(column.astype(column.dtype if np.issubdtype(column.dtype, np.floating) else np.longlong))
    points = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    node.set("points", points)
    data3d.append(node)
    if not len(kept[0]):
        return
    for name, column in zip(scan.columns, kept, strict=True):
        buffers.append(libe57.SourceDestBuffer(file, name, column, len(column), True, False))
    writer = points.writer(buffers)
    writer.write(len(kept[0]))
    writer.close()


def _write_image(file, images2d, image):
    node = libe57.StructureNode(file)
    node.set("name", libe57.StringNode(file, image.name))
    if image.scan_guid:
        node.set("associatedData3DGuid", libe57.StringNode(file, image.scan_guid))
    _set_pose(file, node, image)
    representation = _structure(file, image.numbers)
    blob = libe57.BlobNode(file, len(image.content))
    representation.set(image.blob, blob)
    node.set(image.kind, representation)
    images2d.append(node)
    blob.write(np.frombuffer(image.content, np.uint8).copy(), 0, len(image.content))


def _crc32c_table():
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = (table >> np.uint32(1)) ^ np.where(table & 1, np.uint32(0x82F63B78), np.uint32(0))
    return table


TABLE = _crc32c_table()


def sealed(content):
    """The file with the checksum of each page made right again."""
    pages = np.frombuffer(content[: len(content) // 1024 * 1024], np.uint8).reshape(-1, 1024).copy()
    crc = np.full(len(pages), 0xFFFFFFFF, dtype=np.uint32)
    for k in range(1020):
        crc = TABLE[(crc ^ pages[:, k]) & 255] ^ (crc >> np.uint32(8))
    pages[:, 1020:] = (~crc).astype(">u4").view(np.uint8).reshape(-1, 4)
    return pages.tobytes() + content[len(pages) * 1024 :]


def with_xml(content, old, new):
    """The file with its XML changed, its section moved to the end, checksums right."""
    offset, length = struct.unpack_from("<QQ", content, 24)
    logical = b"".join(content[k : k + 1020] for k in range(0, len(content), 1024))
    begin = offset // 1024 * 1020 + offset % 1024
    xml = logical[begin : begin + length]
    if old not in xml:
        raise AssertionError(f"{old!r} is not in the XML")
    xml = xml.replace(old, new)
    logical = logical[:begin] + xml
    logical += bytes(-len(logical) % 1020)
    pages = b"".join(logical[k : k + 1020] + bytes(4) for k in range(0, len(logical), 1020))
    header = struct.pack("<QQQ", len(pages), offset, len(xml))
    return sealed(pages[:16] + header + pages[40:])
