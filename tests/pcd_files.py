"""PCD files of seeded points, in each encoding and with each kind of colours."""

import struct

import lzf
import numpy as np
from clouds import seeded_cloud

RAW = seeded_cloud(1, num_points=1200)
PACKED = (RAW.colors.astype(np.uint32) << [16, 8, 0]).sum(axis=1, dtype=np.uint32) | np.uint32(0x3F000000)
XYZ = [(axis, "f4", 1, RAW.points_world[:, k]) for k, axis in enumerate("xyz")]
ENCODINGS = ["ascii", "binary", "binary_compressed"]


def number(value, type_):
    return repr(float(np.float32(value))) if type_ == "f4" else repr(value.item())


def content_of(fields, encoding, num_points=1200, **lines):
    """A PCD file of fields (name, type, count, values (N,) or (N, count))."""
    header = {
        "VERSION": "0.7",
        "FIELDS": " ".join(name for name, *_ in fields),
        "SIZE": " ".join(type_[1:] for _, type_, *_ in fields),
        "TYPE": " ".join(type_[0].upper() for _, type_, *_ in fields),
        "COUNT": " ".join(str(count) for _, _, count, _ in fields),
        "WIDTH": str(num_points // 2),
        "HEIGHT": "2",
        "VIEWPOINT": "5 6 7 0 1 0 0",
        "POINTS": str(num_points),
        "DATA": encoding,
    } | lines
    text = "".join(f"{name} {value}\n" for name, value in header.items() if value is not None)
    columns = [np.asarray(v).reshape(num_points, -1).astype("<" + type_) for _, type_, _, v in fields]
    if encoding == "ascii":
        types = [type_ for _, type_, *_ in fields]
        rows = zip(*columns, strict=True)
        fields = (zip(row, types, strict=True) for row in rows)
        body = "\n".join(" ".join(number(v, t) for part, t in row for v in part) for row in fields).encode()
    elif encoding == "binary":
        body = np.hstack([column.view(np.uint8) for column in columns]).tobytes()
    else:
        table = b"".join(c.tobytes() for c, field in zip(columns, fields, strict=True) if field[0] != "_")
        packed = lzf.compress(table, 2 * len(table))
        body = struct.pack("<II", len(packed), len(table)) + packed
    return b"# .PCD v0.7 - Point Cloud Data file format\n" + text.encode() + body


def separate(type_, brightest, names="rgb"):
    values = RAW.colors.astype(np.float64) * (brightest / 255)
    return [*XYZ, *((name, type_, 1, values[:, k]) for k, name in enumerate(names))]


COLORS = {
    "float rgb": [*XYZ, ("rgb", "f4", 1, PACKED.view(np.float32))],
    "uint rgb": [("rgb", "u4", 1, PACKED), *XYZ],
    "int rgba": [*XYZ, ("rgba", "i4", 1, (PACKED | np.uint32(1 << 31)).view(np.int32))],
    "r g b": separate("u1", 255),
    "red green blue": separate("u2", 65535, ("red", "green", "blue")),
    "float r g b": separate("f4", 1),
}
