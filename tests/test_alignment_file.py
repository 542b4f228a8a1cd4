"""What is no alignment is refused: the JSON of tools/align_gravity.py, damaged."""

import json

import numpy as np
import pytest
from refusals import read_or_refused

from piccolo.gravity.alignment import FORMAT, read_alignment

GOOD = {"format": FORMAT, "T_aligned_from_scan": np.eye(4).tolist(), "metres_per_unit": 1.0, "confidence": 1}
SKEWED = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRROR = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    "change",
    [
        {"format": 2},
        {"T_aligned_from_scan": None},
        {"T_aligned_from_scan": [[1, 2], [3, 4]]},
        {"T_aligned_from_scan": SKEWED},
        {"T_aligned_from_scan": MIRROR},
        {"T_aligned_from_scan": [[10**400, 0, 0, 0]] * 4},
        {"T_aligned_from_scan": [[float("nan")] * 4] * 4},
        {"metres_per_unit": 0.0},
        {"metres_per_unit": "m"},
        {"T_aligned_from_scan": [["1", "0", "0", "0"]] * 4},
        {"confidence": 2.0},
    ],
    ids=str,
)
def test_what_is_no_transform_is_refused(tmp_path, change):
    (tmp_path / "T.json").write_text(json.dumps(GOOD | change))
    assert read_or_refused(read_alignment, tmp_path / "T.json")[1]


def test_what_is_written_by_hand_is_read(tmp_path):
    (tmp_path / "T.json").write_text(json.dumps(GOOD))
    np.testing.assert_array_equal(read_alignment(tmp_path / "T.json").T_aligned_from_scan, np.eye(4))


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[" * 100_000, b"[1]", b" " * (2 << 20)], ids=len)
def test_what_is_no_json_is_refused(tmp_path, content):
    (tmp_path / "T.json").write_bytes(content)
    assert read_or_refused(read_alignment, tmp_path / "T.json")[1]
