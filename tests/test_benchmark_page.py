"""BENCHMARK.md was made with the kernels that there are."""

import math
from pathlib import Path

import pytest

from piccolo.system.kernels.jit import inline_kernel, whole
from research.measuring.kernels import digest_kernel, find_changed, list_digests, read_measured

pytestmark = pytest.mark.research
PAGE = Path(__file__).parents[1] / "BENCHMARK.md"


@inline_kernel
def square(value):
    """Return a square."""
    return value * value


@inline_kernel
def product(number: float) -> float:
    return number * number


@inline_kernel
def power(value):
    return value**2


def length(x, y):
    """Return a length."""
    total = square(x) + square(y)
    return math.sqrt(total)


def renamed(a: float, b: float) -> float:
    of_both = product(a) + product(b)  # the same
    return math.sqrt(of_both)


def rewritten(x, y):
    total = square(y) + square(x)
    return math.sqrt(total)


def calls_another(x, y):
    total = power(x) + power(y)
    return math.sqrt(total)


def test_names_comments_and_types_of_a_kernel_do_not_count():
    assert digest_kernel(renamed) == digest_kernel(length)


@pytest.mark.parametrize("other", [rewritten, calls_another])
def test_what_a_kernel_and_those_that_it_calls_compute_counts(other):
    assert digest_kernel(other) != digest_kernel(length)


def test_a_part_of_kernels_that_python_has_called_is_no_kernel_more():
    before = list_digests()
    assert whole(2.5) == 2
    assert list_digests() == before


def test_the_page_was_made_with_these_kernels():
    page = PAGE.read_text()
    commit, measured = read_measured()
    command = f"{page.splitlines()[2].strip()} --out BENCHMARK.md"
    assert f"at commit {commit}," in page, (
        f"BENCHMARK.md and the list of its kernels are of two commits; make both again: {command}"
    )
    assert len(measured) > 60
    changed = find_changed()
    assert not changed, f"changed since BENCHMARK.md was made: {', '.join(changed)}; make it again: {command}"
