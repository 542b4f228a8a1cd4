"""Fuzz a reader by coverage, with libFuzzer's options: fuzz_readers.py las CORPUS -max_total_time=60.

A result or an InputError is right, else it is a finding. Without a corpus of small files little is reached.
"""

import sys
import tempfile
from pathlib import Path
from types import FunctionType

import atheris

sys.path.insert(0, str(Path(__file__).parents[2]))

from piccolo.batch.inputs import read_priors
from piccolo.cloud.cloud_settings import BY_FILE
from piccolo.cloud.stream import FORMATS
from piccolo.judge.result import Result
from piccolo.photo.camera.calibration import read_cameras, read_rig
from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.facts import read_photo_facts
from piccolo.photo.photo import Prior
from piccolo.poses.relative_poses import read_relative_poses
from piccolo.scan_map.map_file import load_map
from piccolo.system.errors import InputError
from research.scene import read_scene

READERS = {suffix[1:]: form.open_source for form in FORMATS for suffix in form.suffixes}
OTHERS = {
    "jpg": read_panorama,
    "tif": read_photo_facts,
    "rig.json": read_rig,
    **dict.fromkeys(("cameras.txt", "cameras.bin", "camera.json", "c.yaml", "c.xml"), read_cameras),
    **dict.fromkeys(("images.txt", "images.bin", "t.json"), lambda path: read_relative_poses(path, [])),
    "map": load_map,
    "csv": lambda path: read_priors(path, Prior()),
    "scene.json": read_scene,
    "jsonl": lambda path: Result.from_json(path.read_text()),
}


def read(name, path):
    """Read a file as a whole, by the reader of that name; errors that users are meant to see pass."""
    try:
        if name in OTHERS:
            OTHERS[name](path)
        else:
            for _ in READERS[name](path, BY_FILE).read_chunks():
                pass
    except (InputError, OSError, UnicodeDecodeError):  # what commands turn into one line
        return


def main(name, flags):
    """Fuzz in this process, which libFuzzer ends; compiled kernels can't be instrumented."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{name}"
        read(name, path)
        for module in [m for n, m in sorted(sys.modules.items()) if n.startswith("piccolo.")]:
            for value in list(vars(module).values()):
                if isinstance(value, FunctionType) and value.__module__ == module.__name__:
                    atheris.instrument_func(value)
        atheris.Setup([sys.argv[0], *flags], lambda data: path.write_bytes(data) and read(name, path))
        atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
