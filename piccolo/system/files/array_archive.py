"""A NumPy archive (.npz) whose arrays are mapped into memory, opened at once, shared by processes; or read.

`numpy.load` reads it too. Its members are stored, not compressed, and padded in their headers, as zipalign
does, so that each array begins at a multiple of 64 bytes of the file.
"""

import io
import math
import mmap
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..jobs.memory import check_memory

ALIGNMENT = 64  # [byte]
PADDING_ID = 0xD935  # of the extra field of a member's header, as zipalign has it
LOCAL_HEADER = struct.Struct("<4s22xHH")  # magic, lengths of the name and of the extra field behind it
MAX_ARRAY_HEADER_SIZE = 4096  # [byte] of an array's header
MAX_HEAD_SIZE = MAX_ARRAY_HEADER_SIZE + 12  # with what stands before it
QUOTED = re.compile(rb"'[^']*'|\"[^\"]*\"")
HEADER_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def write_archive(file: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name; the same arrays give the same bytes."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy")
            info.CRC = info.compress_size = 0  # until it is written
            info.file_size = (
                array.nbytes + MAX_ARRAY_HEADER_SIZE
            )  # by which zipfile chooses the header's form
            is_large = info.file_size * 1.05 > zipfile.ZIP64_LIMIT
            begin = file.tell() + len(info.FileHeader(is_large)) + 4
            size = -begin % ALIGNMENT
            info.extra = struct.pack("<HH", PADDING_ID, size) + bytes(size)
            with archive.open(info, "w") as member:
                npy.write_array(member, array, version=(1, 0), allow_pickle=False)


def read_array_header(head: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Shape, order (True for Fortran's) and type of an array, by the head of its file, and where it begins.

    ValueError for a header that NumPy would have to mend, and warn of: filters of warnings are the process's.
    """
    file = io.BytesIO(head)
    version = npy.read_magic(file)
    if version not in HEADER_READERS:
        raise ValueError(f"an array of version {version[0]}.{version[1]}, wanted 1.0 or 2.0")
    if b"L" in QUOTED.sub(b"", head[file.tell() + 2 * version[0] :].partition(b"}")[0]):
        raise ValueError("a header of Python 2")
    shape, is_fortran, dtype = HEADER_READERS[version](file, max_header_size=MAX_ARRAY_HEADER_SIZE)
    return shape, is_fortran, dtype, file.tell()


class ArrayArchive:
    """An archive's arrays, read whole; or mapped: a page is read when it is needed, writing changes no file.

    ValueError, and what zipfile raises, for an archive that `write_archive` can't have written.
    """

    def __init__(self, path: Path, is_mapped: bool = False) -> None:
        """Read the directory. What may be cut off while it is mapped kills the process (SIGBUS)."""
        with path.open("rb") as file:
            self.status = os.fstat(file.fileno())
            with zipfile.ZipFile(file) as archive:
                infos = archive.infolist()
            self.members = {info.filename.removesuffix(".npy"): info for info in infos}
            if is_mapped:
                self.content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
            else:
                check_memory(self.status.st_size, file.name, "keep it in the cache")
                self.content = mmap.mmap(-1, self.status.st_size)
                file.seek(0)
                file.readinto(self.content)
        size = sum(info.file_size for info in infos)
        if size > len(self.content) or len(self.members) != len(infos):
            raise ValueError(f"arrays of {size} bytes")

    def _begin(self, info: zipfile.ZipInfo) -> int:
        """Return the byte of the file at which a member's content begins."""
        head = self.content[info.header_offset : info.header_offset + LOCAL_HEADER.size]
        magic, name_size, extra_size = LOCAL_HEADER.unpack(head)
        begin = info.header_offset + LOCAL_HEADER.size + int(name_size) + int(extra_size)
        is_stored = info.compress_type == zipfile.ZIP_STORED and info.compress_size == info.file_size
        is_inside = info.header_offset >= 0 and begin + info.file_size <= len(self.content)
        if magic != b"PK\x03\x04" or not is_stored or not is_inside or info.flag_bits & 1:
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
        """Return a member's array, as long as its header says."""
        info = self.members[name]
        begin = self._begin(info)
        head = self.content[begin : begin + min(MAX_HEAD_SIZE, info.file_size)]
        shape, is_fortran, dtype, size = read_array_header(head)
        first = begin + size
        found = info.file_size - size
        promised = math.prod(shape) * dtype.itemsize
        if is_fortran or dtype.hasobject or promised != found or min(shape, default=0) < 0:
            raise ValueError(f"{info.filename} of {found} bytes, which promises {dtype} of shape {shape}")
        if first % ALIGNMENT:
            raise ValueError(f"{info.filename} at byte {first}, no multiple of {ALIGNMENT}")
        if promised == 0:
            return np.empty(shape, dtype)
        return np.frombuffer(self.content, dtype, math.prod(shape), first).reshape(shape)
