"""Tiers of tests: each has one, and what a test uses is noted."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import tiers

from piccolo.localization.paper import PaperMap

TIER = "process"


def test_each_test_has_one_tier(request):
    """Its own mark goes before what its module says."""
    for item in request.session.items:
        assert [name for name in tiers.TIERS if item.get_closest_marker(name)] == [tiers.tier_of(item)]
        assert getattr(item.module, "TIER", "pure") in tiers.TIERS


def test_a_mark_goes_before_the_tier_of_the_module():
    process = pytest.mark.process
    item = SimpleNamespace(nodeid="a", module=SimpleNamespace(TIER="scene"), iter_markers=lambda: [process])
    assert tiers.tier_of(item) == "process"
    item.iter_markers = list
    assert tiers.tier_of(item) == "scene"
    item.module = SimpleNamespace()
    assert tiers.tier_of(item) == "pure"
    item.iter_markers = lambda: [process, pytest.mark.scene]
    with pytest.raises(pytest.UsageError, match="wanted one of them"):
        tiers.tier_of(item)


def test_what_is_used_is_noted(needed):
    assert needed == []
    nothing = np.zeros((0, 3))
    PaperMap(np.eye(3), np.zeros(3), nothing, (), nothing)
    assert needed == ["scene"]
    subprocess.run([sys.executable, "-c", ""], check=True)
    assert needed == ["scene", "process"]
