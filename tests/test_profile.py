"""Kinds of photos: each column of their table is read, and kinds differ in what the table says."""

import ast
from dataclasses import fields
from pathlib import Path

import pytest
from made_up import PARTIAL, PARTIAL_SHAPE, WHOLE, WHOLE_SHAPE

from piccolo.problem.profile import Profile, choose_profile

PICCOLO = Path(__file__).resolve().parents[1] / "piccolo"


def _differences(one, other):
    names = [field.name for field in fields(Profile)]
    return {name for name in names if getattr(one, name) != getattr(other, name)}


def test_every_column_is_read():
    """A column that nothing reads says nothing of a kind."""
    trees = [ast.parse(path.read_text()) for path in PICCOLO.rglob("*.py")]
    read = {node.attr for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert {field.name for field in fields(Profile)} <= read


def test_every_column_differs_between_kinds():
    seen = _differences(WHOLE, PARTIAL) | _differences(WHOLE, WHOLE_SHAPE) | {"discount", "method"}
    assert seen == {field.name for field in fields(Profile)}


def test_a_part_seen_by_shape_differs_as_parts_do_and_as_shape_does():
    of_shape = _differences(WHOLE, WHOLE_SHAPE)
    assert of_shape <= _differences(WHOLE, PARTIAL_SHAPE)
    assert _differences(PARTIAL_SHAPE, WHOLE_SHAPE) == _differences(WHOLE, PARTIAL) - {
        "is_narrow",
        "most_rivals",
        "compares_halves",
    }


@pytest.mark.parametrize(
    ("is_partial", "has_shape", "expected"),
    [(False, False, WHOLE), (True, False, PARTIAL), (False, True, WHOLE_SHAPE)],
)
def test_a_photo_has_the_profile_of_its_kind(is_partial, has_shape, expected):
    assert choose_profile(0.25, is_partial, has_shape) == expected


def test_scores_of_edges_of_a_part_are_discounted_by_its_share():
    found = choose_profile(0.25, is_partial=True, has_shape=True)
    assert found.discount == 0.5
    assert _differences(found, PARTIAL_SHAPE) == {"discount"}


@pytest.mark.parametrize("whole", [WHOLE, PARTIAL])
def test_by_views_only_the_evidence_is_another(whole):
    assert _differences(whole, whole.by_views()) == {"evidence"} | (
        {"is_narrow"} if whole.is_narrow else set()
    )
    assert WHOLE_SHAPE.by_views() == WHOLE_SHAPE
