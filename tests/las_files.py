"""LAS files for tests, written by laspy, and LAZ files with chunks as small as wanted, by lazrs."""

import io
import struct

import laspy
import lazrs
import numpy as np
from clouds import seeded_cloud

from piccolo.cloud.readers.reader import RawCloud

SCALES, OFFSETS = np.array([1e-3, 1e-4, 2e-3]), np.array([637_000.0, 5_849_000.0, -100.0])
PLAIN_SIZE = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}
ANYWHERE = seeded_cloud(2, num_points=1200)
# Where the file's steps of SCALES put them.
RAW = RawCloud(np.rint(ANYWHERE.points_world / SCALES) * SCALES + OFFSETS, ANYWHERE.colors)


def las_bytes(raw, point_format=3, colors=None, withheld=None, extra_bytes=0, intensity=None):
    """A LAS file of a cloud; `colors` (N, 3) uint16 default to the cloud's in full 16 bits."""
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.3")
    header.scales, header.offsets = SCALES, OFFSETS
    for k in range(extra_bytes):
        header.add_extra_dim(laspy.ExtraBytesParams(f"extra{k}", "u1"))
    las = laspy.LasData(header)
    las.x, las.y, las.z = raw.points_world.T
    colors = raw.colors.astype(np.uint16) * 257 if colors is None else colors
    if "red" in header.point_format.dimension_names:
        las.red, las.green, las.blue = colors.T
    if intensity is not None:
        las.intensity = intensity
    if withheld is not None:
        las.withheld = withheld
    content = io.BytesIO()
    las.write(content)
    return content.getvalue()


def with_records(las, *records):
    """A LAS file with the records of a coordinate system, each (id, content), in place of its own."""
    (header_size,) = struct.unpack_from("<H", las, 94)
    (points,) = struct.unpack_from("<I", las, 96)
    head = bytearray(las[:header_size])
    content = b""
    for record_id, data in records:
        content += struct.pack("<H16sHH32s", 0, b"LASF_Projection", record_id, len(data), b"") + data
    struct.pack_into("<II", head, 96, header_size + len(content), len(records))
    return bytes(head) + content + las[points:]


def laz_bytes(las, chunk=None, cuts=()):
    """A LAS file compressed in chunks of `chunk` points, or between the points in `cuts`."""
    header_size, offset, num_vlrs, point_format, size, count = struct.unpack_from("<HIIBHI", las, 94)
    if las[25] >= 4:
        (count,) = struct.unpack_from("<Q", las, 247)
    laszip = lazrs.LazVlr.new_for_compression(point_format, size - PLAIN_SIZE[point_format], chunk is None)
    record = bytearray(laszip.record_data())
    if chunk is not None:
        struct.pack_into("<I", record, 12, chunk)
        laszip = lazrs.LazVlr(bytes(record))
    vlr = struct.pack("<2x16sHH32s", b"laszip encoded", 22204, len(record), b"") + record
    head = bytearray(las[:offset]) + vlr
    struct.pack_into("<HIIB", head, 94, header_size, len(head), num_vlrs + 1, point_format | 0x80)
    content = io.BytesIO()
    content.write(head)
    compressor = lazrs.LasZipCompressor(content, laszip)
    points = np.frombuffer(las, np.uint8, count * size, offset)
    if chunk is None:
        compressor.compress_chunks(np.split(points, np.array(cuts, dtype=int) * size))
    else:
        compressor.compress_many(points)
    compressor.done()
    return content.getvalue()
