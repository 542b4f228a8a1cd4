"""A NumPy archive (.npz) whose arrays are mapped into memory: opened at once, shared by processes.

`numpy.load` reads it too. Its members are stored, not compressed, and padded in their headers, as zipalign
does, so that each array begins at a multiple of 64 bytes of the file.
"""

import io
import math
import mmap
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any
from warnings import catch_warnings, simplefilter

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

ALIGNMENT = 64  # [byte]
PADDING_ID = 0xD935  # of the extra field of a member's header, as zipalign has it
LOCAL_HEADER = struct.Struct("<4s22xHH")  # magic, lengths of the name and of the extra field behind it
MEMBER_MAGIC = b"PK\x03\x04"
MAX_HEADER_SIZE = 4096  # [byte] of an array's header


def write_archive(file: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name; the same arrays give the same bytes."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy")
            info.CRC = info.compress_size = 0  # until it is written
            info.file_size = array.nbytes + MAX_HEADER_SIZE  # by which zipfile chooses the header's form
            is_large = info.file_size * 1.05 > zipfile.ZIP64_LIMIT
            begin = file.tell() + len(info.FileHeader(is_large)) + 4
            size = -begin % ALIGNMENT
            info.extra = struct.pack("<HH", PADDING_ID, size) + bytes(size)
            with archive.open(info, "w") as member:
                npy.write_array(member, array, version=(1, 0), allow_pickle=False)


class MappedArchive:
    """An archive's arrays, mapped into memory: pages are read when they are needed; writing changes no file.

    ValueError, and what zipfile raises, for an archive that `write_archive` can't have written.
    """

    def __init__(self, file: IO[bytes]) -> None:
        """Read the directory."""
        with zipfile.ZipFile(file) as archive:
            infos = archive.infolist()
        self.members = {info.filename.removesuffix(".npy"): info for info in infos}
        self.content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
        size = sum(info.file_size for info in infos)
        if size > len(self.content) or len(self.members) != len(infos):
            raise ValueError(f"arrays of {size} bytes")

    def _begin(self, info: zipfile.ZipInfo) -> int:
        """Where in the file a member's content begins."""
        head = self.content[info.header_offset : info.header_offset + LOCAL_HEADER.size]
        magic, name_size, extra_size = LOCAL_HEADER.unpack(head)
        begin = info.header_offset + LOCAL_HEADER.size + int(name_size) + int(extra_size)
        is_stored = info.compress_type == zipfile.ZIP_STORED and info.compress_size == info.file_size
        is_inside = info.header_offset >= 0 and begin + info.file_size <= len(self.content)
        if magic != MEMBER_MAGIC or not is_stored or not is_inside or info.flag_bits & 1:
            raise ValueError(f"{info.filename} in another way than a prepared map has it")
        return begin

    def check(self, name: str) -> None:
        """Refuse a member that does not have the checksum which the directory names."""
        info = self.members[name]
        begin = self._begin(info)
        with memoryview(self.content) as whole, whole[begin : begin + info.file_size] as member:
            if zlib.crc32(member) != info.CRC:
                raise ValueError(f"{info.filename} with a wrong checksum")

    def array(self, name: str) -> NDArray[Any]:
        """A member's array, as long as its header says."""
        info = self.members[name]
        begin = self._begin(info)
        head = io.BytesIO(self.content[begin : begin + min(MAX_HEADER_SIZE, info.file_size)])
        with catch_warnings():
            simplefilter("error")  # NumPy warns of headers that it had to mend
            if npy.read_magic(head) != (1, 0):
                raise ValueError(f"{info.filename} of another version than 1.0")
            shape, is_fortran, dtype = npy.read_array_header_1_0(head, max_header_size=MAX_HEADER_SIZE)
        first, found = begin + head.tell(), info.file_size - head.tell()
        promised = math.prod(shape) * dtype.itemsize
        if is_fortran or dtype.hasobject or promised != found or min(shape, default=0) < 0:
            raise ValueError(f"{info.filename} of {found} bytes, which promises {dtype} of shape {shape}")
        if first % ALIGNMENT:
            raise ValueError(f"{info.filename} at byte {first}, no multiple of {ALIGNMENT}")
        if promised == 0:
            return np.empty(shape, dtype)
        return np.frombuffer(self.content, dtype, math.prod(shape), first).reshape(shape)


def open_archive(path: Path) -> MappedArchive:
    """The arrays of an archive that `write_archive` wrote."""
    with path.open("rb") as file:
        return MappedArchive(file)
