"""Every result that a test makes is checked by the schema that users have."""

import json
import os
import signal
from pathlib import Path

import jsonschema
import pytest
import rooms

from piccolo.result import Result

SCHEMA = json.loads((Path(__file__).resolve().parents[1] / "docs" / "result.schema.json").read_text())
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)

# A shell starts what runs in the background with Ctrl-C ignored, as then would be what a test starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


# The files that take longest begin first, so that in the end no worker waits for another. Before them one
# worker runs what compiles most kernels, and the other what needs none, so that none is compiled twice.
SLOWEST = (
    "test_documents.py", "test_panorama_formats.py", "test_cloud_damage.py", "test_cloud_e57.py",
    "test_tools.py", "test_coloring.py", "test_localize_cameras.py", "test_bundle.py", "test_jobs.py",
    "test_camera_tools.py", "test_walk.py", "test_focal_length.py", "test_cluster.py", "test_shape.py",
    "test_batch.py", "test_focal_consensus.py", "test_localize.py", "test_batch_second_look.py",
    "test_verification.py", "test_one_judge.py", "test_doors.py", "test_localization.py",
    "test_localization_covariance.py",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    order = {name: number for number, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@pytest.fixture(autouse=True, scope="session")
def _checked_results():
    """Result.to_json as ever, but for a text that the schema does not know."""
    to_json = Result.to_json

    def checked(result):
        text = to_json(result)
        VALIDATOR.validate(json.loads(text))
        return text

    patch = pytest.MonkeyPatch()
    patch.setattr(Result, "to_json", checked)
    yield
    patch.undo()


@pytest.fixture(autouse=True, scope="session")
def _shared_folder(tmp_path_factory):
    """The temporary folder of the run, above that of the worker if there are several."""
    folder = tmp_path_factory.getbasetemp()
    rooms.SHARED[:] = [folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder]


@pytest.fixture(scope="session")
def scene():
    """A room's cloud and three panoramas, in a folder with a blank in its name; only to be read."""
    words = "--seed 7 --points 60000 --panoramas 3 --width 512"
    return rooms.make_once("a scene", lambda folder: rooms.write_room(folder, words))
