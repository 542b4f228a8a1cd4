"""Photos of a batch localized with those taken with them: what the result of a sure photo does not keep."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import rooms

from piccolo.judge.belief import make_belief
from piccolo.judge.reasons import Reason
from piccolo.judge.result import Result
from piccolo.localization.means import Means
from piccolo.system.jobs.threads import Stopwatch
from piccolo.together.among import Known, compare_sure, recall_found
from piccolo.together.mirrored import refuse_mirrored

TIER = "scene"

SEED = 5
REFUSED = Result(belief=make_belief([0.6]).rule_out(Reason.MIRRORED))
UNSURE = Result(belief=make_belief([0.6]))


@pytest.mark.parametrize("other", [REFUSED, UNSURE])
def test_a_sure_photo_is_compared_with_its_mirror_image_if_another_was_mirrored(other):
    """Its result, as files have it, does not keep the evidence; with it, the photo is not refused."""
    scan_map = rooms.scan_map(SEED)
    ((photo, _),) = rooms.take_photos(SEED, 150.0, {1: [0.0, 0.0, 0.0]})
    found = rooms.locate(photo, scan_map, rooms.KNOWN)
    assert found.status == "localized"
    kept = Result.from_json(found.to_json())
    known = Known(lambda: photo, rooms.KNOWN, kept, False)
    recalled = recall_found(scan_map, known, rooms.WORKERS, Stopwatch())
    assert recalled.alone.mirrored is None
    members = {0: recalled, 1: SimpleNamespace(alone=other)}
    compared = compare_sure(members, Means(rooms.KNOWN.effort, rooms.WORKERS, Stopwatch()))
    assert compared[1] is members[1]
    if other is UNSURE:
        assert compared == members
        return
    assert compared[0].alone.standings[0].score == pytest.approx(recalled.found.selection.best.score)
    assert compared[0].alone.mirrored is not None
    results = {k: one.alone for k, one in compared.items()}
    assert refuse_mirrored(results, {0: (), 1: ()}, compared, 0.9) == {}
    assert replace(compared[0].alone, standings=(), mirrored=None) == recalled.alone
