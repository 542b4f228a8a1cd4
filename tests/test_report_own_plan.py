"""Plans of the user's own: the map from pixels to metres by control points, and what is refused."""

import numpy as np
import pytest

from piccolo.errors import InputError
from piccolo.report.plan_image import plan_matrix, read_control_points


def test_two_control_points_give_a_turn_and_a_scale():
    pixels = np.array([[100.0, 200.0], [300.0, 50.0]])
    angle, scale = 0.7, 0.02
    flipped = pixels * [1.0, -1.0]
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    (a, b, c, d, e, f), error = plan_matrix(pixels, flipped @ turn.T + [3.0, -4.0])
    np.testing.assert_allclose([[a, c], [b, d]], turn @ np.diag([1.0, -1.0]))
    np.testing.assert_allclose([e, f, error], [3.0, -4.0, 0.0], atol=1e-9)
    with pytest.raises(InputError, match="one point or on one line"):
        plan_matrix(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]), np.zeros((3, 2)))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("u,v,x\n1,2,3\n", "found the columns"),
        ("u,v,x,y\n1,2,3,4\n", "found 1 control points"),
        ("u,v,x,y\n1,2,3,nan\n2,3,4,5\n", "found 2 control points"),
        ("u,v,x,y\n1,2,3,four\n", "could not convert"),
        ("u,v,x,y\n1,2,3\n", "wanted a CSV file"),
    ],
)
def test_control_points_that_are_none(tmp_path, text, found):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=found):
        read_control_points(path)
