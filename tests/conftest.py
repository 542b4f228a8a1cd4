"""Every result that a test makes is checked by the schema that users have."""

import json
import signal
from pathlib import Path

import jsonschema
import pytest
from rooms import write_room

from piccolo.result import Result

SCHEMA = json.loads((Path(__file__).resolve().parents[1] / "docs" / "result.schema.json").read_text())
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)

# A shell starts what runs in the background with Ctrl-C ignored, as then would be what a test starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


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


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """A room's cloud and three panoramas, in a folder with a blank in its name; only to be read."""
    words = "--seed 7 --points 60000 --panoramas 3 --width 512"
    return write_room(tmp_path_factory.mktemp("a scene"), words)
