"""Archives of arrays that are mapped into memory, or read: NumPy reads them too, and no file changes."""

import io
import zipfile

import numpy as np
import pytest

from piccolo.files import array_archive
from piccolo.files.array_archive import ALIGNMENT, ArrayArchive, read_header, write_archive

ARRAYS = {
    "a": np.arange(7, dtype=np.int8),
    "longer_name": np.linspace(0.0, 1.0, 300).reshape(100, 3),
    "none": np.zeros((0, 4), np.float32),
    "one": np.array("text"),
    "flags": np.array([True, False]),
}


@pytest.fixture
def path(tmp_path):
    with (tmp_path / "a.npz").open("wb") as file:
        write_archive(file, ARRAYS)
    return tmp_path / "a.npz"


@pytest.mark.parametrize("is_mapped", [False, True])
@pytest.mark.parametrize("limit", [zipfile.ZIP64_LIMIT, 2000])
def test_arrays_come_back_aligned_and_numpy_reads_them_too(tmp_path, monkeypatch, limit, is_mapped):
    """Large members have a longer header in the archive."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", limit)
    with (tmp_path / "a.npz").open("wb") as file:
        write_archive(file, ARRAYS)
    archive = ArrayArchive(tmp_path / "a.npz", is_mapped)
    assert list(archive.members) == list(ARRAYS)
    with np.load(tmp_path / "a.npz") as loaded:
        for name, array in ARRAYS.items():
            archive.check(name)
            found = archive.array(name)
            assert (found.dtype, found.shape) == (array.dtype, array.shape)
            np.testing.assert_array_equal(found, array)
            np.testing.assert_array_equal(loaded[name], array)
            assert found.ctypes.data % ALIGNMENT == 0 or found.size == 0


def test_what_is_written_to_an_array_changes_no_file(path):
    before = path.read_bytes()
    ArrayArchive(path, is_mapped=True).array("longer_name")[:] = -1.0
    assert path.read_bytes() == before
    assert ArrayArchive(path).array("longer_name").min() == 0.0


def test_each_changed_byte_of_an_array_is_noticed(path):
    content = path.read_bytes()
    first = content.index(ARRAYS["longer_name"].tobytes())
    for k in range(first, first + ARRAYS["longer_name"].nbytes, 97):
        path.write_bytes(content[:k] + bytes([content[k] ^ 1]) + content[k + 1 :])
        with pytest.raises(ValueError, match=r"longer_name.npy with a wrong checksum"):
            ArrayArchive(path).check("longer_name")


def test_no_array_reaches_beyond_the_file(path, monkeypatch):
    info = ArrayArchive(path).members["a"]
    for offset in (len(path.read_bytes()) - 40, len(path.read_bytes())):
        archive = ArrayArchive(path)
        archive.members["a"].header_offset = offset
        with pytest.raises((ValueError, array_archive.struct.error)):
            archive.array("a")
    archive = ArrayArchive(path)
    archive.members["a"].header_offset, archive.members["a"].file_size = info.header_offset, 10**6
    archive.members["a"].compress_size = 10**6
    with pytest.raises(ValueError, match="in another way than a prepared map has it"):
        archive.array("a")


def test_a_header_that_numpy_would_have_to_mend_is_refused_without_a_warning():
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (3, 6)})
    head = file.getvalue()
    assert read_header(head) == ((3, 6), False, np.dtype("<f8"), len(head))
    with pytest.raises(ValueError, match="a header of Python 2"):
        read_header(head.replace(b"(3, 6), }  ", b"(3L, 6L), }"))
    with pytest.raises(ValueError, match=r"version 3.0, wanted 1.0 or 2.0"):
        read_header(head.replace(b"NUMPY\x01", b"NUMPY\x03"))
