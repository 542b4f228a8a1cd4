"""The parts of a GLB file: JSON and a buffer."""

import struct
from pathlib import Path

from ...errors import InputError

GLB_MAGIC = b"glTF"
WANTED = "wanted a whole glTF 2.0 mesh"


def has_glb_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` says it is GLB."""
    return head.startswith(GLB_MAGIC)


def glb_parts(path: Path, content: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the first buffer of a GLB file."""
    if len(content) < 20:
        raise InputError(f"{path}: {len(content)} bytes, {WANTED}")
    version, size, json_size, kind = struct.unpack_from("<III4s", content, 4)
    if version != 2 or kind != b"JSON":
        raise InputError(f"{path}: GLB version {version}, first part {kind!r}, {WANTED}")
    if size > len(content) or 20 + json_size > size:
        raise InputError(
            f"{path}: the header promises {size} bytes and {json_size} of JSON, found {len(content)}, "
            f"{WANTED}"
        )
    text, start = content[20 : 20 + json_size], 20 + json_size
    if start + 8 > size:
        return text, None
    binary_size, kind = struct.unpack_from("<I4s", content, start)
    if kind != b"BIN\0":
        return text, None
    if start + 8 + binary_size > size:
        raise InputError(
            f"{path}: the header promises {binary_size} bytes of data, found {size - start - 8}, {WANTED}"
        )
    return text, content[start + 8 : start + 8 + binary_size]
