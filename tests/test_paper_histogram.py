import numpy as np
import pytest

from piccolo.paper.search import color_histogram, histogram_intersection


def test_histogram_counts_solid_angle_and_intersection_is_one_for_equal_ones():
    rgb = np.zeros((64, 128, 3), dtype=np.float32)
    rgb[:16] = 1.0  # a quarter of the rows, about the zenith: (1 - cos 45 deg) / 2 of the sphere
    histogram = color_histogram(rgb, np.ones((64, 128), dtype=bool), 4)
    assert histogram.sum() == pytest.approx(1.0)
    assert histogram[-1] == pytest.approx((1 - np.cos(np.pi / 4)) / 2, rel=1e-6)
    everywhere = np.ones((16, 32), dtype=bool)
    black = color_histogram(np.zeros((16, 32, 3), dtype=np.float32), everywhere, 8)
    white = color_histogram(np.ones((16, 32, 3), dtype=np.float32), everywhere, 8)
    assert histogram_intersection(black, black) == pytest.approx(1.0)
    assert histogram_intersection(black, white) == 0.0
    histogram = color_histogram(np.ones((16, 32, 3), np.float32), np.zeros((16, 32), bool), 8)
    assert histogram.sum() == 0.0
