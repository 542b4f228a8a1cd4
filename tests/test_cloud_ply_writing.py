"""PLY files as they are written: read back by our reader and by plyfile."""

import numpy as np
import pytest
from plyfile import PlyData

from piccolo.cloud import open_cloud
from piccolo.cloud.ply_writer import needs_double, vertex_rows, write_ply, writing_ply


def _cloud(num_points, dtype):
    rng = np.random.default_rng(2)
    points = (500_000.0 + rng.uniform(-9.0, 9.0, (num_points, 3))).astype(dtype)
    return points, rng.integers(0, 256, (num_points, 3), dtype=np.uint8), rng.integers(0, 99, num_points)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_cloud_comes_back(tmp_path, dtype):
    points, colors, labels = _cloud(1000, dtype)
    path = tmp_path / "a b.ply"
    write_ply(path, vertex_rows(points, colors, labels.astype(np.int32)))
    vertex = PlyData.read(path)["vertex"]
    assert [p.name for p in vertex.properties] == ["x", "y", "z", "red", "green", "blue", "label"]
    for k, name in enumerate("xyz"):
        assert vertex[name].dtype == dtype
        assert np.array_equal(vertex[name], points[:, k])
    assert np.array_equal(np.stack([vertex["red"], vertex["green"], vertex["blue"]], axis=1), colors)
    assert np.array_equal(vertex["label"], labels)
    chunks = list(open_cloud([path]).chunks([]))
    assert np.array_equal(np.concatenate([points_world for points_world, _ in chunks]), points)


def test_chunks_make_the_same_bytes_as_all_at_once(tmp_path):
    points, colors, _ = _cloud(1234, np.float32)
    rows = vertex_rows(points, colors)
    write_ply(tmp_path / "once.ply", rows)
    with writing_ply(tmp_path / "parts.ply", rows.dtype) as writer:
        for begin in range(0, 1234, 100):
            writer.add(rows[begin : begin + 100])
    assert (tmp_path / "once.ply").read_bytes() == (tmp_path / "parts.ply").read_bytes()


def test_an_error_leaves_nothing(tmp_path):
    rows = vertex_rows(*_cloud(10, np.float32)[:2])
    with (
        pytest.raises(ValueError, match="invalid literal"),
        writing_ply(tmp_path / "a.ply", rows.dtype) as writer,
    ):
        writer.add(rows["x"].astype(str))
    assert list(tmp_path.iterdir()) == []


def test_float32_is_kept_where_it_holds_a_tenth_of_a_millimetre():
    for size, is_double in ((500.0, False), (5000.0, True)):
        assert needs_double(np.array([np.zeros(3), np.full(3, size)]), np.eye(4), 1.0) == is_double
    assert not needs_double(np.array([np.zeros(3), np.full(3, 500.0)]), np.eye(4), 0.001)
