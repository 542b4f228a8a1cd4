"""Jobs that are killed at any moment and begun again leave the files of one that was not."""

import signal
import subprocess
import sys
import time

import pytest
import rooms
from batches import COARSELY, ROOT, untimed
from pictures import encoded, write
from poses import result

from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.batch.jobs import steps_file
from piccolo.cli.localize import main

TIER = "process"

SEED = 1
WIDTH = 256
PATIENCE = 120.0  # [s]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Options of a scan and two photos, and a file of their relative poses."""
    folder = tmp_path_factory.mktemp("killed")
    cloud = rooms.write_cloud(folder / "scan.ply", SEED, 20_000)
    queries = [rooms.query(SEED, index=k, width=WIDTH) for k in range(2)]
    photos = [folder / f"photo {k}.png" for k in range(2)]
    for path, query in zip(photos, queries, strict=True):
        write(path, encoded(query.rgb, ".png"))
    taken = [result(path, query.pose) for path, query in zip(photos, queries, strict=True)]
    export(taken, "nerfstudio", folder / "relative.json", Options(size=(WIDTH, WIDTH // 2)))
    words = ["--cloud", cloud, "--cache", str(folder / "maps"), "--gravity", "known", "--quiet"]
    return folder, [*words, "--pano", *map(str, photos)]


def _wait_for_step(process, out, num_lines):
    """Return when a job has kept so many lines, or has ended."""
    end = time.monotonic() + PATIENCE
    while process.poll() is None and time.monotonic() < end:
        kept = [path for path in (out, steps_file(out)) if path.exists()]
        if any(path.read_bytes().count(b"\n") >= num_lines for path in kept):
            return
        time.sleep(0.01)


@pytest.mark.parametrize(("kind", "num_lines"), [("walk", 2), ("relative", 0), ("together", 0), ("color", 4)])
@pytest.mark.usefixtures("coarse_colors", "searched_once")
def test_a_job_that_is_killed_goes_on(scene, tmp_path, kind, num_lines):
    folder, words = scene

    def words_of(name):
        colored = tmp_path / f"{name}.ply"
        more = {
            "walk": ["--walk", "--times", "names"],
            "relative": ["--relative", str(folder / "relative.json")],
            "together": ["--together"],
            "color": ["--color-scan", str(colored)],
        }[kind]
        return [*words, *more, "--out", str(tmp_path / f"{name}.jsonl")], tmp_path / f"{name}.jsonl", colored

    whole, expected, colored = words_of("whole")
    code = main(whole)
    again, out, colored_again = words_of("killed")
    process = subprocess.Popen([sys.executable, "-c", COARSELY, *again], cwd=ROOT, stderr=subprocess.PIPE)
    _wait_for_step(process, out, num_lines)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert main(again) == code
    assert untimed(out) == untimed(expected)
    assert not steps_file(out).exists()
    assert colored.exists() == colored_again.exists() == (kind == "color")
    assert kind != "color" or colored.read_bytes() == colored_again.read_bytes()
