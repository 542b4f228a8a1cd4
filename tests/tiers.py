"""Three tiers of tests, by what they use; a test that uses more than its tier may fails.

Pure tests use no map of a scan and start no process. A module whose tests use maps says TIER = "scene", one
whose tests start processes TIER = "process"; a single test that starts some is marked `process`.
"""

import subprocess
from multiprocessing.process import BaseProcess

import pytest

from piccolo.localization.paper import PaperMap
from piccolo.scan_map.scan_map import ScanMap
from piccolo.system.kernels.ahead import HELPS

FONTS = "fc-list"  # lists a machine's fonts for Matplotlib, once; as HELPS compile kernels
TIERS = ("pure", "scene", "process")  # each may use what those before it use


def tier_of(item):
    """The mark of a test, or the tier of its module; pure if neither says so."""
    marks = [mark.name for mark in item.iter_markers() if mark.name in TIERS]
    if len(set(marks)) > 1:
        raise pytest.UsageError(f"{item.nodeid}: found the marks {marks}, wanted one of them")
    return marks[0] if marks else getattr(item.module, "TIER", "pure")


def watch(patch):
    """Note from now on which tiers are needed; returns the list in which they are noted."""
    needed = []

    def note(owner, name, tier):
        original = getattr(owner, name)

        def noting(self, *given, **options):
            is_help = tier == "process" and bool(given) and (HELPS in given[0] or FONTS in given[0])
            needed.extend([] if is_help else [tier])
            return original(self, *given, **options)

        patch.setattr(owner, name, noting)

    note(ScanMap, "__init__", "scene")
    note(PaperMap, "__init__", "scene")
    note(subprocess.Popen, "__init__", "process")
    note(BaseProcess, "start", "process")
    return needed
