"""Mutations by hand, in a process of their own: maps with right checksums, and files of both caches.

Started by fuzz_readers.py with a group, a seed, the first mutation, how many, and a file that names the one
under way, and stays where the process is killed. Each is drawn by its number.
"""

import faulthandler
import logging
import resource
import signal
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import _checkout  # noqa: F401
import numpy as np
from numpy.typing import NDArray

from piccolo.cloud.stream import stream_of_arrays
from piccolo.coarse_to_fine.candidate_views import CandidateViews
from piccolo.coarse_to_fine.config import METHOD, Beam
from piccolo.coarse_to_fine.localize import localize
from piccolo.coarse_to_fine.map_file import ARRAYS, load_map, save_map
from piccolo.coarse_to_fine.open_map import FOLDER, cached_map
from piccolo.coarse_to_fine.prior import apply_prior
from piccolo.coarse_to_fine.scan_addition import add_scan
from piccolo.coarse_to_fine.scan_map import ScanMap, prepare_map, sparse_candidates
from piccolo.coarse_to_fine.settings import CoarseToFineSettings, Prior
from piccolo.errors import InputError
from piccolo.geometry.pose import Pose, is_correct
from piccolo.panorama import Panorama
from piccolo.runtime.array_archive import write_archive
from piccolo.runtime.kernel_cache import digest_of, read_whole
from piccolo.runtime.stopwatch import Stopwatch
from piccolo.runtime.threads import Workers
from piccolo.scenes.synthetic.world import make_query, make_world, scan_world

ROOM_SIZE, SHIFT, NEAR = np.array([2.4, 2.2, 2.2]), np.array([320.0, -150.0, 7.0]), 0.3  # [m]
QUICK = METHOD._replace(beam=Beam(32, 8, 3, 1), min_starts=48)
NAMES, WORKERS, SHA256 = ("A", "B"), Workers(1), 64 * "0"
SETTINGS = CoarseToFineSettings(gravity="known", num_yaws=24, prior=Prior(within=NAMES[:1]))
HANG_S, MEMORY_KB = 10.0, 2 << 20  # of processor time, at most, for one; of memory for all
LOCALIZED_FRACTION, ADDED_FRACTION = 0.1, 0.05  # of the maps that are read
Trial = Callable[[np.random.Generator], str]


def small_map() -> tuple[ScanMap, Panorama, Pose]:
    """The map of a room with the candidates around one camera, that camera's panorama, and its true pose."""
    world = make_world(3, ROOM_SIZE)
    points, colors, _ = scan_world(world, 8000, WORKERS)
    whole = prepare_map(stream_of_arrays(points.astype(np.float64) + SHIFT, colors), WORKERS, "z")
    query = make_query(world, 0, "clean", 256, WORKERS)
    pose = Pose(query.pose.R_cam_from_world, query.pose.center_world + SHIFT)
    near = apply_prior(whole, Prior(tuple(pose.center_world), NEAR))
    centers = whole.centers[near.sparse]
    sparse, _ = sparse_candidates(centers)
    small = replace(
        near,
        centers=centers,
        sparse=sparse,
        wide_features=near.wide_features[sparse],
        wide_seen=near.wide_seen[sparse],
        views=CandidateViews(near.octree, centers),
        scan_sha256=SHA256,
        scan_names=NAMES,
        scan_of_candidate=(np.arange(len(centers)) == len(centers) - 1).astype(np.uint16),
    )
    return small, Panorama(query.rgb, np.ones(query.rgb.shape[:2], np.bool_)), pose


def mutated_bytes(rng: np.random.Generator, content: bytes) -> bytes:
    """A file with bits flipped, a block overwritten, cut, emptied or grown; often near one of its ends."""
    changed = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        end = int(rng.choice([200, 3000, len(changed)]))
        at = min(int(rng.integers(end)), len(changed) - 1)
        at = at if rng.random() < 0.5 else len(changed) - 1 - at
        kind, size = rng.integers(5), int(rng.integers(1, 40))
        if kind < 2:
            changed[at] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            changed[at : at + size] = rng.bytes(size)
        elif kind == 3:
            changed = changed[:at] if rng.random() < 0.5 else changed[at:]
        else:
            changed[at:at] = rng.bytes(size)
        if not changed:
            break
    return bytes(changed)


def drawn(rng: np.random.Generator, array: NDArray[Any], size: Any = None) -> NDArray[Any]:
    """Values that an array's type can hold: extreme ones, none at all, and some like its own."""
    kind, values = array.dtype.kind, array.ravel()
    like = values[rng.integers(array.size, size=size)]
    if kind == "f":
        odd = rng.choice([np.nan, np.inf, -np.inf, 0.0, 1e-40, 1e30, -1.0, 1e5], size=size)
        return np.asarray([like * rng.normal(1.0, 0.1), like + rng.normal(), odd][rng.integers(3)])
    if kind in "iu":
        info = np.iinfo(array.dtype)
        odd = rng.choice([info.min, info.max, 0, 1, array.size], size=size)
        near = like.astype(np.int64) + rng.integers(-9, 10, size=size)
        return np.asarray([like, odd, near][rng.integers(3)])
    return np.asarray(like)


def mutated_array(rng: np.random.Generator, array: NDArray[Any]) -> NDArray[Any]:
    """An array with other values, bits, rows, shape or type."""
    changed, kind = array.copy(), rng.integers(10)
    flat = changed.reshape(-1)
    if array.size == 0 or kind == 0:
        return np.asarray(rng.choice([0, 1, 3]) * np.ones(rng.integers(0, 4, size=rng.integers(0, 4))))
    if kind <= 3:  # a few values
        where = rng.integers(array.size, size=rng.integers(1, 5))
        flat[where] = drawn(rng, array, len(where)).astype(array.dtype)
    elif kind <= 5 and array.dtype.kind != "U":
        raw = flat.view(np.uint8)
        raw[rng.integers(raw.size, size=rng.integers(1, 5))] ^= np.uint8(1 << rng.integers(8))
    elif kind == 6 and array.dtype.kind in "fiu":  # all values
        flat[:] = [flat * drawn(rng, flat), flat + drawn(rng, flat), flat[::-1], rng.permutation(flat)][
            rng.integers(4)
        ].astype(array.dtype)
    elif kind == 7 and array.ndim:
        rows = rng.integers(len(array), size=2)
        changed[rows] = changed[rows[::-1]]
    elif kind == 8:
        shapes = [array[:-1], array[..., :-1], np.concatenate([array, array[-1:]])] if array.ndim else []
        shapes += [array[None], array.ravel(), array.T, np.zeros_like(array)]
        return np.asarray(shapes[rng.integers(len(shapes))])
    elif kind == 9 and array.dtype.kind != "U":
        return array.astype(rng.choice(["f4", "f8", "i4", "i8", "u1", "?", ">f4", "U5"]))
    return changed


def status_in(scan_map: ScanMap, panorama: Panorama, pose: Pose) -> str:
    """What the panorama's pose in a map is called; never "localized" if it is not the true one."""
    result = localize(scan_map, panorama, SETTINGS, WORKERS, Stopwatch(), QUICK)
    if result.status == "localized" and not is_correct(result.pose, pose):
        raise RuntimeError(f"a wrong pose is called localized: {result.pose}")
    return result.status


def added_to(scan_map: ScanMap) -> str:
    """Whether a scan of points here and there could be put into a map, which must stay one."""
    rng = np.random.default_rng(1)
    points, colors = (
        rng.uniform(-2.0, 2.0, (1500, 3)) + SHIFT,
        rng.integers(256, size=(1500, 3), dtype=np.uint8),
    )
    try:
        with np.errstate(all="ignore"):
            added = add_scan(scan_map, stream_of_arrays(points, colors), "C", WORKERS, Stopwatch())
    except InputError as error:
        if "\n" in str(error):
            raise RuntimeError(f"more than a line: {error}") from error
        return "nothing added"
    with tempfile.TemporaryDirectory() as folder:
        save_map(added, Path(folder) / "added.map")
        load_map(Path(folder) / "added.map")
    return "added to"


def trial_of_maps(folder: Path) -> Trial:
    """Mutates arrays of a map, writes it with right checksums, reads it, and localizes in what is read."""
    scan_map, panorama, pose = small_map()
    if status_in(scan_map, panorama, pose) != "localized":  # this also loads the kernels
        raise RuntimeError("the map itself is no good")
    path = folder / "a.map"
    save_map(scan_map, path)
    with np.load(path) as archive:
        arrays = dict(archive)

    def run(rng: np.random.Generator) -> str:
        members = dict(arrays)
        with np.errstate(all="ignore"):
            for name in rng.choice(list(arrays), size=rng.integers(1, 3)):
                members[name] = mutated_array(rng, members[name])
        if rng.random() < 0.01:
            del members[rng.choice(list(members))]
        with path.open("wb") as file:
            write_archive(file, members)
        try:
            found = load_map(path)
        except InputError as error:
            if "\n" in str(error) or not str(error).startswith(f"{path}: "):
                raise RuntimeError(f"no line that names the file: {error}") from error
            return "refused"
        if rng.random() < ADDED_FRACTION:
            return f"read and {added_to(found)}"
        return f"read and {status_in(found, panorama, pose)}" if rng.random() < LOCALIZED_FRACTION else "read"

    return run


def trial_of_caches(folder: Path) -> Trial:
    """Mutates the bytes of a map in the cache, or of compiled code, and reads it as a run does."""
    logging.getLogger("piccolo").addHandler(logging.NullHandler())
    scan_map, _, _ = small_map()
    key, payload = 32 * "0", np.random.default_rng(0).bytes(20_000)
    cached_map(folder, key, SHA256, lambda: scan_map, Stopwatch())
    path, compiled = folder / FOLDER / f"{key}.piccolo-map", folder / f"{key}.kernel"
    whole = path.read_bytes()

    def run(rng: np.random.Generator) -> str:
        if rng.random() < 0.5:
            compiled.write_bytes(mutated_bytes(rng, digest_of(compiled.name, payload) + payload))
            if read_whole(compiled) not in (None, payload):
                raise RuntimeError("damaged compiled code is believed")
            return "compiled code"
        path.write_bytes(mutated_bytes(rng, whole))
        found, warning = cached_map(folder, key, SHA256, lambda: scan_map, Stopwatch())
        for name in ARRAYS:
            if not np.array_equal(getattr(found, name), getattr(scan_map, name)):
                raise RuntimeError(f"a damaged map is believed: {name}")
        if not np.array_equal(found.octree.nodes, scan_map.octree.nodes):
            raise RuntimeError("a damaged octree is believed")
        if warning and path.read_bytes() != whole:
            raise RuntimeError(f"the map in the cache was not made anew: {warning}")
        return "map made anew" if warning else "map harmless"

    return run


def trials(group: str, folder: Path, seed: int, numbers: range, at: Path) -> Iterator[str]:
    """Run mutations; what became of each."""
    trial = {"maps": trial_of_maps, "caches": trial_of_caches}[group](folder)
    faulthandler.register(signal.SIGPROF, chain=True)  # and the process ends
    for k in numbers:
        at.write_text(f"{group}: mutation {k} of seed {seed}\n")
        signal.setitimer(signal.ITIMER_PROF, HANG_S)
        yield trial(np.random.default_rng([seed, k]))
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    at.unlink(missing_ok=True)


if __name__ == "__main__":
    group, at, (seed, first, count) = sys.argv[1], Path(sys.argv[5]), map(int, sys.argv[2:5])
    faulthandler.enable()
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as temporary:
        counts = Counter(trials(group, Path(temporary), seed, range(first, first + count), at))
    memory_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"{group}: {count} mutations of seed {seed}, {memory_kb >> 10} MB:",
        *map("{0[1]} {0[0]};".format, counts.items()),
    )
    sys.exit(memory_kb > MEMORY_KB)
