"""Kill a batch at random moments, take it up again each time, and compare its results with a whole run's.

    python tools/interrupt_batches.py --kills 200 --seed 1
    python tools/interrupt_batches.py --full-disk
    python tools/interrupt_batches.py --photos 1000 --service

Makes a small room of its own. --full-disk runs with a limit of the file's size, --service names the photos on
standard input one by one and watches the memory. Exit code 1 if a line was lost, doubled or different.
"""

import argparse
import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import _checkout  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]
ROOM = "--seed 7 --size 4.5 3.5 2.5 --points 60000 --panoramas 4 --width 256"
PAPER = "--preset paper --num-translations 4 --num-iterations 5 --max-points 5000"
LIMITED = "import resource, runpy, sys; n = int(sys.argv.pop(1)); sys.argv.pop(0); "
LIMITED += (
    "resource.setrlimit(resource.RLIMIT_FSIZE, (n, n)); runpy.run_path(sys.argv[0], run_name='__main__')"
)
Lines = list[dict[str, object]]


def make_photos(folder: Path, count: int) -> list[str]:
    """A room's cloud in the folder, and `count` photos in it."""
    subprocess.run(
        [sys.executable, ROOT / "tools/make_room.py", "--out", folder / "room", *ROOM.split()], check=True
    )
    made = sorted((folder / "room" / "images").iterdir())
    (folder / "photos").mkdir()
    for k in range(count):
        shutil.copy(made[k % len(made)], folder / "photos" / f"{k:04d}.jpg")
    return [str(path) for path in sorted((folder / "photos").iterdir())]


def command(folder: Path, out: Path | None, pano: str, preset: str) -> list[str]:
    """The command line of a batch."""
    words = ["localize.py", "--cloud", str(folder / "room" / "cloud.ply"), "--pano", pano, *preset.split()]
    return [*words, "--quiet", *(["--out", str(out)] if out else [])]


def lines_of(path: Path) -> Lines:
    """The results in a file, without what differs from run to run."""
    return [json.loads(line) | {"seconds": None} for line in path.read_text().splitlines()]


def run_killed(arguments: Sequence[str], num_kills: int, seconds: float, rng: random.Random) -> int:
    """Start a batch again and again, and kill it after up to so many seconds; returns how often it was."""
    killed = 0
    while killed < num_kills:
        process = subprocess.Popen([sys.executable, *arguments], cwd=ROOT)
        try:
            process.wait(rng.uniform(0.0, seconds))
        except subprocess.TimeoutExpired:
            process.kill()
            killed += 1
        if process.wait() >= 0:
            break
    return killed


def interrupted(folder: Path, preset: str, num_kills: int, rng: random.Random) -> dict[str, object]:
    """Batches killed until they are done: how often, and how many files differ from the whole run's."""
    whole, out = folder / "whole.jsonl", folder / "poses.jsonl"
    first = command(folder, folder / "first.jsonl", str(folder / "photos"), preset)
    subprocess.run([sys.executable, *first], cwd=ROOT, check=False)  # which may compile kernels
    begin = time.monotonic()
    subprocess.run(
        [sys.executable, *command(folder, whole, str(folder / "photos"), preset)], cwd=ROOT, check=False
    )
    seconds, expected = time.monotonic() - begin, lines_of(whole)
    kills = runs = num_different = 0
    while kills < num_kills:
        out.unlink(missing_ok=True)
        arguments = command(folder, out, str(folder / "photos"), preset)
        kills += run_killed(arguments, min(10, num_kills - kills), 1.2 * seconds, rng)
        subprocess.run([sys.executable, *arguments], cwd=ROOT, check=False)
        runs += 1
        num_different += lines_of(out) != expected
    return {"lines": len(expected), "kills": kills, "runs": runs, "different": num_different}


def on_full_disk(folder: Path, preset: str) -> dict[str, object]:
    """A batch whose file may grow to a third first: exit code, lines kept, and whether it ends whole."""
    whole, out = folder / "whole.jsonl", folder / "poses.jsonl"
    pano = str(folder / "photos")
    subprocess.run([sys.executable, *command(folder, whole, pano, preset)], cwd=ROOT, check=False)
    limit = whole.stat().st_size // 3
    words = [sys.executable, "-c", LIMITED, str(limit), *command(folder, out, pano, preset)]
    first = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    kept = len(lines_of(out))
    subprocess.run([sys.executable, *command(folder, out, pano, preset)], cwd=ROOT, check=False)
    said = first.stderr.strip().splitlines()[-1:]
    is_different = lines_of(out) != lines_of(whole)
    return {"exit_code": first.returncode, "said": said, "kept": kept, "different": int(is_different)}


def served(folder: Path, preset: str, photos: Sequence[str]) -> dict[str, object]:
    """Photos named one by one on standard input: how many are answered, the memory after 20 and later."""
    words = [sys.executable, *command(folder, None, "-", preset)]
    resident: list[float] = []
    with subprocess.Popen(
        words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for photo in photos:
            process.stdin.write(f"{photo}\n")
            process.stdin.flush()
            process.stdout.readline()
            pages = Path(f"/proc/{process.pid}/statm").read_text().split()[1]
            resident.append(int(pages) * 4096 / 1e6)
        process.stdin.close()
    after = max(resident[:20])
    growth = max(resident[20:], default=after) - after
    return {
        "answered": len(resident),
        "after_20_mb": round(after, 1),
        "growth_mb": round(growth, 1),
        "different": 0,
    }


def main() -> int:
    """Run what is asked for, print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--photos", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--preset", choices=["default", "paper"], default="paper", help="paper is quicker")
    parser.add_argument("--full-disk", action="store_true")
    parser.add_argument("--service", action="store_true")
    arguments = parser.parse_args()
    preset = PAPER if arguments.preset == "paper" else ""
    with tempfile.TemporaryDirectory(prefix="interrupt batches ") as temporary:
        folder = Path(temporary)
        photos = make_photos(folder, arguments.photos)
        if arguments.service:
            report = served(folder, preset, photos)
        elif arguments.full_disk:
            report = on_full_disk(folder, preset)
        else:
            report = interrupted(folder, preset, arguments.kills, random.Random(arguments.seed))
    print(json.dumps(report | {"preset": arguments.preset, "seed": arguments.seed}))
    return int(report["different"] != 0)


if __name__ == "__main__":
    sys.exit(main())
