#!/usr/bin/env python3
"""Fuzz the readers: coverage-guided mutations of small files by atheris for a given time; maps by hand."""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FunctionType

import _checkout  # noqa: F401
import numpy as np

from piccolo.batch.priors import read_priors
from piccolo.camera.files import read_cameras, read_rig
from piccolo.cli.command import command, option
from piccolo.cloud import FORMATS
from piccolo.cloud.readers.reader import PLAIN, CloudFormat
from piccolo.coarse_to_fine.map_file import load_map
from piccolo.coarse_to_fine.settings import Prior
from piccolo.errors import InputError
from piccolo.panorama import read_panorama
from piccolo.panorama.photo import photo_of
from piccolo.result import Result
from piccolo.scenes.scene import read_scene

EPILOG = """\
example:
  python tools/fuzz_readers.py --reader las --seconds 3600 --corpus samples --crashes found

Each reader gets the files of --corpus that end as its formats do, or one of a few bytes, and mutations of
them. A good result or an InputError is right; anything else, over 20 s or over 2 GB is a finding: the file
is kept in --crashes, named after its reader. atheris: pip install atheris.

The readers `maps` and `caches` need no atheris and no corpus: --count mutations of a small map's arrays with
right checksums, some of which a photo is then localized in, and of the bytes of a map and of compiled code in
their caches. A map that is refused, or a right or no pose, is right; the number of what is found is printed.
"""
BY_HAND = ("maps", "caches")
TIMEOUT_S, MEMORY_MB, MAX_SIZE = 20, 2048, 1 << 16


def read_format(form: CloudFormat, path: Path) -> object:
    """The sizes of all chunks of a file, by one format's reader."""
    return [len(chunk.colors) for chunk in form.open_source(path, PLAIN).read_chunks()]


READERS: dict[str, tuple[tuple[str, ...], Callable[[Path], object]]] = {
    **{
        min(f.suffixes, key=lambda s: (len(s), s))[1:]: (tuple(sorted(f.suffixes)), partial(read_format, f))
        for f in FORMATS
    },
    "panorama": ((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"), read_panorama),
    "metadata": ((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"), photo_of),
    "priors": ((".csv",), lambda path: read_priors(path, Prior())),
    "result": ((".jsonl",), lambda path: Result.from_json(path.read_text())),
    "scene": ((".json",), read_scene),
    "cameras": ((".txt", ".json"), read_cameras),
    "rigs": ((".json",), read_rig),
    "map": ((".map", ".npz"), load_map),
}


def try_file(name: str, path: Path) -> None:
    """Read a file; errors that users are meant to see pass."""
    try:
        READERS[name][1](path)
    except (InputError, OSError, UnicodeDecodeError):  # what the command lines catch or turn into one
        return


def readers_functions() -> list[FunctionType]:
    """The plain functions of the readers' modules; compiled kernels can't be instrumented."""
    packages = "piccolo.batch", "piccolo.camera", "piccolo.cloud", "piccolo.panorama"
    names = [name for name in sorted(sys.modules) if name.startswith(packages)]
    values = [value for name in names for value in vars(sys.modules[name]).values()]
    unique = {id(v): v for v in values if isinstance(v, FunctionType) and v.__module__.startswith("piccolo")}
    return list(unique.values())


def fuzz(name: str, flags: list[str]) -> None:
    """Fuzz in this process, which libFuzzer ends."""
    import atheris  # noqa: PLC0415  # an optional library

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{READERS[name][0][0]}"

        def one(data: bytes) -> None:
            path.write_bytes(data)
            try_file(name, path)

        one(b"0")
        for function in readers_functions():
            atheris.instrument_func(function)
        atheris.Setup([sys.argv[0], *flags], one)
        atheris.Fuzz()


def fuzz_apart(name: str, arguments: argparse.Namespace) -> bool:
    """Fuzz one reader in a process of its own; True if something was found."""
    suffixes = READERS[name][0]
    with tempfile.TemporaryDirectory() as corpus:
        (Path(corpus) / "seed").write_bytes(np.arange(64, dtype=np.uint8).tobytes())
        for path in sorted(arguments.corpus.rglob("*")) if arguments.corpus else []:
            if path.suffix.lower() in suffixes and path.stat().st_size <= MAX_SIZE:
                (Path(corpus) / path.name).write_bytes(path.read_bytes())
        prefix = arguments.crashes / f"{name}-"
        command = [sys.executable, __file__, "--inside", name, corpus, f"-artifact_prefix={prefix}"]
        flags = {"max_total_time": arguments.seconds, "timeout": TIMEOUT_S, "seed": arguments.seed}
        flags |= {"rss_limit_mb": MEMORY_MB, "max_len": MAX_SIZE, "print_final_stats": 1}
        command += [f"-{name}={value}" for name, value in flags.items()]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    stats = [line for line in done.stderr.splitlines() if "number_of_executed_units" in line]
    print(f"{name}: {stats[0].split()[-1] if stats else '?'} inputs, {'FOUND' if done.returncode else 'ok'}")
    if done.returncode:
        print("\n".join(done.stderr.splitlines()[-25:]), file=sys.stderr)
    return done.returncode != 0


def fuzz_by_hand(group: str, arguments: argparse.Namespace) -> bool:
    """Fuzz maps or caches in a process of their own; True if something was found."""
    at = arguments.crashes / f"{group}-{arguments.seed}"
    numbers = map(str, (arguments.seed, arguments.first, arguments.count, at))
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("_fuzz_maps.py"), group, *numbers], check=False
    )
    return done.returncode != 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    parser.add_argument("--reader", choices=[*READERS, *BY_HAND], nargs="+", default=[*READERS, *BY_HAND])
    option(parser, "--seconds N", "for each reader", default=60)
    option(parser, "--seed N", default=1)
    option(parser, "--count N", "mutations of maps, and of caches", default=1000)
    option(parser, "--first N", "number of the first of them", default=0)
    option(parser, "--corpus FOLDER", "files to begin with")
    option(parser, "--crashes FOLDER", "for what is found", required=True)


@command(__file__, __doc__, EPILOG, add_arguments, "0 nothing found, 1 something")
def main(arguments: argparse.Namespace) -> int:
    """Fuzz the readers one by one."""
    arguments.crashes.mkdir(parents=True, exist_ok=True)
    runs = [(fuzz_by_hand if name in BY_HAND else fuzz_apart, name) for name in arguments.reader]
    return int(any([run(name, arguments) for run, name in runs]))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        fuzz(sys.argv[2], sys.argv[3:])
    raise SystemExit(main())
