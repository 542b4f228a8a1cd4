"""Photo Sphere XMP: copies of JPEGs that carry heading, pitch and roll. The picture's bytes stay as they are.

https://developers.google.com/streetview/spherical-metadata. The XMP packet is changed as text, so that what
others wrote into it stays as they wrote it.
"""

import re
import struct
from collections.abc import Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from ..errors import InputError
from ..files.atomic import replacing_folder, write_atomically
from ..files.json_file import read_bytes
from ..geometry.rotations import DECIMALS, heading_pitch_roll_deg
from ..panorama.gpano import CROP_FIELDS, NAMESPACE, PREFIX
from ..panorama.picture import WANTED, open_picture
from .posed_images import Format, Options, PosedImage, check_size

JPEG_MAGIC = b"\xff\xd8"
APP0 = 0xE0
APP1 = 0xE1
SCAN = 0xDA
MARKER = re.compile(rb"\xff+")
EXIF_MARK, XMP_MARK = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0"
MAX_BODY_SIZE = 0xFFFF - 2
POSE_NAMES = ("PoseHeadingDegrees", "PosePitchDegrees", "PoseRollDegrees")
END = re.compile(rb"</([A-Za-z_][\w.-]{0,40}):RDF\s{0,9}>")
ABOUT = re.compile(rb":about\s{0,9}=\s{0,9}(\"[^\"<]{0,999}\"|'[^'<]{0,999}')")
# what is left of a description that had nothing but the pose
LEFTOVER = re.compile(
    rb"<[\w.-]{1,40}:Description [\w.-]{1,40}:about=(\"[^\"<]{0,999}\"|'[^'<]{0,999}') xmlns:GPano=\""
    + re.escape(NAMESPACE)
    + rb"\"/>"
)
EMPTY_PACKET = (
    b'<?xpacket begin="\xef\xbb\xbf" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
    b'<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"></rdf:RDF></x:xmpmeta>'
    b'<?xpacket end="w"?>'
)


class Segment(NamedTuple):
    """One segment of a JPEG: data[begin:end], marker and length included."""

    marker: int
    begin: int
    end: int


def write(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a copy of each picture into a new folder, under its name in `images` or its file name."""
    names = [image.name if options.images else Path(image.name).name for image in images]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{twice}: two pictures have this name; use `images` FOLDER to distinguish them")
    with replacing_folder(out) as folder:
        for name, image in zip(names, images, strict=True):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_atomically(folder / name, _copy(image))


def _copy(image: PosedImage) -> bytes:
    """Return the picture's file with its pose."""
    return with_pose(image.path, read_bytes(image.path, WANTED), heading_pitch_roll_deg(image.pose))


def with_pose(path: Path, data: bytes, angles_deg: tuple[float, float, float]) -> bytes:
    """Return the JPEG `data` with heading, pitch and roll in its XMP packet; other segments keep their bytes.

    Fields of the pose that were there are replaced. Without a packet one is put behind JFIF's and EXIF's.
    """
    segments = list(jpeg_segments(data)) if data.startswith(JPEG_MAGIC) else []
    if not segments or segments[-1].marker != SCAN:
        raise InputError(f"{path}: no JPEG, or a damaged one; XMP can be written into a whole JPEG only")
    with open_picture(path, data) as image:
        size = image.size
    bodies = [data[begin + 4 : end] if marker == APP1 else b"" for marker, begin, end in segments]
    packets = [i for i, body in enumerate(bodies) if body.startswith(XMP_MARK)]
    edits = []  # begin, end, what comes there
    for i in packets:
        packet = without_pose(bodies[i][len(XMP_MARK) :])
        if i == packets[0]:
            packet = _with_fields(path, packet, angles_deg, size)
        edits.append((segments[i].begin, segments[i].end, _segment(path, packet)))
    if not packets:
        pairs = zip(segments, bodies, strict=True)  # JFIF's and EXIF's segments have to be the first
        first = takewhile(lambda pair: pair[0].marker == APP0 or pair[1].startswith(EXIF_MARK), pairs)
        place = max((segment.end for segment, _ in first), default=len(JPEG_MAGIC))
        edits = [(place, place, _segment(path, _with_fields(path, EMPTY_PACKET, angles_deg, size)))]
    pieces = []
    begin = 0
    for edit_begin, edit_end, new in edits:
        pieces += [data[begin:edit_begin], new]
        begin = edit_end
    return b"".join([*pieces, data[begin:]])


def jpeg_segments(data: bytes) -> Iterator[Segment]:
    """Yield the segments of a JPEG up to the header of its first scan; fewer if it is damaged."""
    begin = len(JPEG_MAGIC)
    while found := MARKER.match(data, begin):
        begin = found.end() - 1  # a marker may be filled up with FF
        if begin + 4 > len(data):
            return
        marker, length = struct.unpack_from(">xBH", data, begin)
        end = begin + 2 + length
        if length < 2 or end > len(data):
            return
        yield Segment(marker, begin, end)
        if marker == SCAN:
            return
        begin = end


def _segment(path: Path, packet: bytes) -> bytes:
    body = XMP_MARK + packet
    if len(body) > MAX_BODY_SIZE:
        raise InputError(f"{path}: its XMP leaves no room for the pose: with the pose it may have 64 KB")
    return struct.pack(">BBH", 0xFF, APP1, len(body) + 2) + body


def without_pose(packet: bytes) -> bytes:
    """Return the packet without the fields of a pose, as attributes or as elements."""
    for prefix in dict.fromkeys(PREFIX.findall(packet)):
        for name in POSE_NAMES:
            field = re.escape(prefix) + b":" + name.encode()
            packet = re.sub(rb"\s" + field + rb"\s{0,9}=\s{0,9}(\"[^\"<>]*\"|'[^'<>]*')", b"", packet)
            packet = re.sub(rb"<" + field + rb"\s{0,9}(/>|>[^<>]*</" + field + rb"\s{0,9}>)", b"", packet)
    return LEFTOVER.sub(b"", packet)


def _with_fields(
    path: Path, packet: bytes, angles_deg: tuple[float, float, float], size: tuple[int, int]
) -> bytes:
    """Return the packet with a description more, of the pose and of what a viewer needs and is not there yet.

    A packet without an end of its RDF is damaged and gives way to a new one.
    """
    if not END.search(packet):
        packet = EMPTY_PACKET
    *_, end = END.finditer(packet)
    names = [re.findall(re.escape(p) + rb":(\w{1,60})", packet) for p in set(PREFIX.findall(packet))]
    known = {name.decode() for some in names for name in some}
    fields = {} if "ProjectionType" in known else {"ProjectionType": "equirectangular"}
    if not known & set(CROP_FIELDS):
        check_size(f"{path}: without GPano's crop", size)
        fields |= {name: str(value) for name, value in zip(CROP_FIELDS, (0, 0, *size, *size), strict=True)}
    fields |= {n: f"{angle:.{DECIMALS}f}" for n, angle in zip(POSE_NAMES, angles_deg, strict=True)}
    attributes = "".join(f' GPano:{name}="{value}"' for name, value in fields.items()).encode()
    about = ABOUT.search(packet)  # has to be the same in all descriptions
    rdf, place = end[1], end.start()
    description = b"<%s:Description %s:about=%s" % (rdf, rdf, about.group(1) if about else b'""')
    description += b' xmlns:GPano="%s"%s/>' % (NAMESPACE, attributes)
    return packet[:place] + description + packet[place:]


TEXT = "copies of the JPEGs with heading, pitch and roll as Photo Sphere XMP; `out` is a new folder"
GPANO = Format("gpano", TEXT, write, is_folder=True, forbidden="", cameras="spheres", check=_copy)
