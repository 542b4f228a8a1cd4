"""Files of points with bytes changed at random: read, or refused in one line, and nothing else."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from las_files import las_bytes, laz_bytes
from plyfile import PlyData
from refusals import assert_refused, mutated, read_or_refused
from test_cloud_las import RAW
from test_cloud_morton import read
from test_cloud_npz import PAIR, WHOLE
from test_cloud_pcd import COLORS, ENCODINGS, content_of
from test_cloud_ply import vertices
from test_cloud_ptx import TWO_SCANS, pts
from test_cloud_text import lines_of

from piccolo.cloud import open_source
from piccolo.cloud.readers.reader import RawCloud

SMALL = RawCloud(RAW.points_world[:60], RAW.colors[:60])


def written(write, *arguments, **options):
    file = io.BytesIO()
    write(file, *arguments, **options)
    return file.getvalue()


def ply(**options):
    return written(PlyData([vertices()], **options).write)


CONTENTS = {
    "a.las": las_bytes(SMALL, 3),
    **{f"{f}.laz": laz_bytes(las_bytes(SMALL, f, extra_bytes=1), 25) for f in (2, 5, 7, 10)},
    **{f"{f} of any size.laz": laz_bytes(las_bytes(SMALL, f), cuts=(1, 40)) for f in (3, 8)},
    **{f"{encoding}.pcd": content_of(COLORS["uint rgb"], encoding) for encoding in ENCODINGS},
    "binary.ply": ply(byte_order=">"),
    "text.ply": ply(text=True),
    "a.npy": written(np.save, WHOLE),
    "a.npz": written(np.savez, **PAIR),
    "packed.npz": written(np.savez_compressed, **PAIR),
    "a.ptx": "\n".join(TWO_SCANS).encode(),
    "a.pts": "\n".join(["600", *pts()[:600], "600", *pts()[600:]]).encode(),
    "a.txt": "\n".join(lines_of(RAW)).encode(),
}


@pytest.mark.parametrize("name", CONTENTS)
@settings(deadline=None, max_examples=50)
@given(data=st.data())
def test_mutated_files_are_read_or_refused(name, data, tmp_path_factory):
    content = CONTENTS[name]
    cut = data.draw(st.sampled_from([120, 300, len(content) // 2]))
    head = mutated(data.draw, st.integers, content[:cut])
    path = tmp_path_factory.getbasetemp() / f"mutated {name}"
    path.write_bytes(head + mutated(data.draw, st.integers, content[cut:]))
    result, message = read_or_refused(lambda path: read(path) if path.stat().st_size > 8 else None, path)
    assert result is None or result[0].shape == result[1].shape
    assert message or result or path.stat().st_size <= 8


@pytest.mark.parametrize("name", ["a.las", "7.laz"])
def test_a_file_cut_while_it_is_read_is_refused(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(CONTENTS[name])
    source = open_source(path)
    path.write_bytes(CONTENTS[name][:-300])
    assert_refused("the file was cut while it was read", lambda _: list(source.read_chunks()), path)
