"""Measure accuracy, damage, phone photos, time and memory, and write them as one page of Markdown."""

import datetime
import platform
import subprocess
import tempfile
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import cv2
import numba
import numpy as np
from scipy.special import chdtri

import piccolo
from piccolo import InputError, PaperSettings, Pose, Result
from piccolo.cli.command import Arguments, option
from piccolo.cloud.stream import open_cloud
from piccolo.geometry.pose_gaussian import subtract
from piccolo.photo.panorama import read_panorama
from piccolo.system.arrays import Bytes
from piccolo.system.files.atomic import write_atomically
from piccolo.system.jobs.threads import Workers, num_cores

from ..evaluation.query_result import QueryResult
from ..evaluation.tables import Table, count_rows, reliability_table
from ..scene import Query, Scene, read_scene
from ..synthetic.world import PHOTO_FOV_DEG, cut_photo, make_query, make_world, write_photo
from .claims import Points, Trial
from .confidence import DAMAGED_SCANS, damage_trial
from .kernels import MEASURED, list_lines
from .speed import clean_queries, kernel_table, size_table

EPILOG = """\
examples:
  python tools/benchmark.py all --scenes BENCH/house BENCH/hall --out BENCHMARK.md
  python tools/benchmark.py all --scenes BENCH/house --only kernels

A folder has cloud.ply, images, and queries.json with true poses. If it has cameras/, its pictures are photos,
each with a calibration cameras/NAME.camera.json; else they are panoramas. Damaged pictures and phone photos
are made from the panoramas of the variant clean, or of all if there is none.
"""
ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "BENCHMARK.md"
PAPER_SETTINGS = PaperSettings()
NUM_BY_PAPER = 2  # panoramas of each scene
CONFIDENCES = (0.0, 0.5, 0.9, 0.99, 1.0)
MAX_WRONG = 20  # lines
COLUMNS = ("queries", "right", "localized", "wrong of these", "outside", "mm", "deg", "s")

PARTS = {  # title and text of each
    "panoramas": """\
## Panoramas as they are
All panoramas of each scene. clean: as the scan was made; tilt: the camera in any rotation; photo: other
exposure and colours, noise, blur; change: furniture moved, people and things added.""",
    "damage": """\
## Damaged panoramas and scans
Seeded damage to panoramas of all scenes. Panoramas that are mirrored or of another place have no right pose:
each one that is localized is wrong.""",
    "photos": f"""\
## Phone photos
Pinhole photos of {PHOTO_FOV_DEG:g} degrees, cut out of the panoramas in random directions, so they are soft.
EXIF has the focal length in whole millimetres. Photos of a scene's own come with their calibrations.
The corridor's true poses are ARKit's, good to about 2 cm and 0.5 degrees, so `outside` says little there.""",
    "paper": """\
## Against the preset `paper`
The same panoramas by both methods, gravity known. The preset is Algorithm 1 of the paper.""",
    "size": """\
## Time and memory by the size of the scan
Each row is measured in a process of its own, gravity known and unknown. A scene is resampled; rooms are those
of `tools/make_room.py`, 50,000 points each. Features: with the map's file. The peak of memory is that of the
whole process.""",
    "kernels": """\
## Kernels against `cv2.remap`
The reference is `cv2.remap`, one thread: 8 bits, 3 channels, bilinear, a pixel a point.""",
}
HEAD = """\
# Benchmark

    python tools/benchmark.py {words}

Measured on {date} at commit {commit}, Python {python}, NumPy {numpy}, Numba {numba}, OpenCV {opencv};
{processor}, {cores} cores.

Right: under 0.1 m and 5 degrees. Wrong of these: localized, but not right. Outside: localized, and the true
pose is not in the 95 % region of the covariance. mm, deg: median errors of the right poses. s: median seconds
of a photo, without reading it. Gravity is `auto` where nothing else is said.
"""


def is_outside(row: QueryResult) -> bool:
    """Return True if the true pose lies outside of the 95 % region of the covariance."""
    pose = row.result.best_pose
    covariance = row.result.covariance
    if covariance is None or pose is None or row.true_pose is None:
        return False
    error = subtract(row.true_pose, pose)
    return bool(error @ np.linalg.solve(covariance.matrix, error) > chdtri(6, 0.05))


def row_cells(rows: Sequence[QueryResult]) -> tuple[str, ...]:
    """Return the statistics of some queries, as COLUMNS."""
    right = [row for row in rows if row.is_correct()]
    counts = count_rows(rows)
    outside = sum(is_outside(row) for row in rows if row.is_localized)
    mm = f"{1000.0 * np.median([row.position_error for row in right]):.1f}" if right else "-"
    deg = f"{np.degrees(np.median([row.rotation_error for row in right])):.3f}" if right else "-"
    seconds = np.median([row.seconds for row in rows])
    return (str(len(rows)), *map(str, counts), str(outside), mm, deg, f"{seconds:.2f}")


def accuracy_table(rows: Sequence[QueryResult]) -> Table:
    """Return the statistics of each label."""
    labels = dict.fromkeys(row.variant for row in rows)
    lines = [(label, *row_cells([row for row in rows if row.variant == label])) for label in labels]
    return Table("", ("", *COLUMNS), tuple(lines))


def camera_path(scene: Scene, query: Query) -> Path:
    """Return where the calibration of a photo would be."""
    return scene.folder / "cameras" / f"{query.image.stem}.camera.json"


class Bench:
    """Measurements of one run of the command."""

    def __init__(self, arguments: Arguments) -> None:
        self.arguments = arguments
        scenes = [read_scene(folder) for folder in arguments.scenes]
        if empty := [scene for scene in scenes if not scene.queries]:
            raise InputError(f"{empty[0].folder}: found no queries, wanted pictures with true poses")
        self.of_photos = [scene for scene in scenes if camera_path(scene, scene.queries[0]).exists()]
        self.of_panoramas = [scene for scene in scenes if scene not in self.of_photos]
        self.rows: dict[str, list[QueryResult]] = {part: [] for part in PARTS}

    def add(self, part: str, label: str, query: str, true_pose: Pose | None, result: Result) -> None:
        """Keep the result of a query, the label of the table's line as its variant."""
        row = QueryResult(part, query, label, None, true_pose, result)
        self.rows[part].append(row)
        end = "" if true_pose is None else ", right" if row.is_correct() else ", not right"
        self.arguments.note(f"{part}: {label}: {query}: {result.status}{end}")

    def measure(self) -> None:
        """Localize all queries."""
        for number, scene in enumerate(self.of_panoramas):
            others = [*self.of_panoramas[number + 1 :], *self.of_panoramas[:number]]
            self.measure_panoramas(scene, others)
        for scene in self.of_photos if "photos" in self.arguments.only else []:
            scan = piccolo.open_scan(scene.cloud, cache=False)
            for query in scene.queries:
                result = scan.localize(piccolo.Photo(query.image, camera=camera_path(scene, query)))
                self.add("photos", f"{scene.name}, own photos", query.image.name, query.pose, result)

    def measure_panoramas(self, scene: Scene, others: Sequence[Scene]) -> None:
        """Localize the panoramas of a scene, and what is made of them."""
        scan = piccolo.open_scan(scene.cloud, cache=False)
        if "panoramas" in self.arguments.only:
            for query in scene.queries:
                label = f"{scene.name}, {query.variant}"
                self.add("panoramas", label, query.image.name, query.pose, scan.localize(query.image))
        if "damage" in self.arguments.only:
            self.measure_damage(scene, scan, read_foreign(others))
        if "photos" in self.arguments.only:
            self.measure_photos(scene, scan)
        if "paper" in self.arguments.only:
            self.measure_paper(scene, scan)

    def measure_damage(self, scene: Scene, scan: piccolo.Scan, others: Sequence[Bytes]) -> None:
        """Localize damaged panoramas, and panoramas in damaged scans."""
        queries = clean_queries(scene, self.arguments.damaged)
        panoramas = [read_panorama(query.image).rgb for query in queries]
        for number, (query, rgb) in enumerate(zip(queries, panoramas, strict=True)):
            rng = np.random.default_rng([number, len(scene.queries), 60])
            other = np.asarray(cv2.resize(others[number % len(others)], rgb.shape[1::-1]), np.uint8)
            taken = Trial("as taken", rgb, query.pose)
            elsewhere = Trial("another place", other, None)
            for trial in (taken, *damage_trial(taken, other, rng), elsewhere):
                name = f"{scene.name}/{query.image.name}"
                result = scan.localize(piccolo.Photo(trial.rgb, mask=trial.is_masked))
                self.add("damage", trial.case, name, trial.true_pose, result)
        cloud = open_cloud([scene.cloud]).read()
        points: Points = (cloud.points + cloud.origin_world, cloud.colors)
        for label, change in DAMAGED_SCANS.items():
            damaged_points, colors = change(points, np.random.default_rng(61))
            damaged_scan = piccolo.open_scan(piccolo.Cloud(damaged_points, colors=colors))
            for query in queries:
                name = f"{scene.name}/{query.image.name}"
                self.add("damage", label, name, query.pose, damaged_scan.localize(query.image))

    def measure_photos(self, scene: Scene, scan: piccolo.Scan) -> None:
        """Localize photos that are cut out of panoramas, with exact and with rounded focal lengths."""
        rng = np.random.default_rng([len(scene.queries), 62])
        queries = clean_queries(scene, self.arguments.photos)
        with tempfile.TemporaryDirectory() as folder:
            for number in range(self.arguments.photos if queries else 0):
                query = queries[number % len(queries)]
                path = Path(folder) / f"{scene.name}_{number}.jpg"
                photo = cut_photo(read_panorama(query.image).rgb, query.pose, PHOTO_FOV_DEG, rng)
                write_photo(photo, path)
                exact = scan.localize(piccolo.Photo(path, focal_px=photo.focal_px))
                self.add("photos", f"{scene.name}, exact focal length", path.name, photo.pose, exact)
                rounded = scan.localize(path)
                self.add("photos", f"{scene.name}, focal length by EXIF", path.name, photo.pose, rounded)

    def measure_paper(self, scene: Scene, scan: piccolo.Scan) -> None:
        """Localize the same panoramas by both methods."""
        by_paper = piccolo.open_scan(scene.cloud, cache=False, settings=PAPER_SETTINGS)
        for query in clean_queries(scene, NUM_BY_PAPER):
            name = f"{scene.name}/{query.image.name}"
            for label, one in {"preset paper": by_paper, "default method": scan}.items():
                self.add("paper", label, name, query.pose, one.localize(query.image, gravity="known"))

    def sections(self) -> Iterator[str]:
        """Yield the parts of the page after its head, measured by now or as they come."""
        for part, rows in self.rows.items():
            if rows:
                yield f"{PARTS[part]}\n\n{accuracy_table(rows).markdown()}"
            if rows and part == "paper":
                yield f"The preset takes {time_ratio(rows):.1f} times as long.\n"
        rows = [row for part, own in self.rows.items() if part != "paper" for row in own]
        if rows:
            stated = [row.result.confidence for row in rows]
            table = reliability_table("confidence", stated, [row.is_correct() for row in rows], CONFIDENCES)
            text = "All queries above but those of the preset comparison."
            yield f"## Confidences\n{text}\n\n{table.markdown()}\n{wrong_lines(rows)}"
        if self.of_panoramas and "size" in self.arguments.only:
            scene = self.of_panoramas[0]
            sizes = size_table(scene, self.arguments.points, self.arguments.rooms, self.arguments.note)
            yield f"{PARTS['size']}\n\n{sizes.markdown()}"
        if self.of_panoramas and "kernels" in self.arguments.only:
            scene = self.of_panoramas[0]
            rgb = read_panorama(scene.queries[0].image).rgb
            speeds = kernel_table(open_cloud([scene.cloud]).read(), rgb)
            yield f"{PARTS['kernels']}\n{speeds.markdown()}"


def read_foreign(scenes: Sequence[Scene]) -> list[Bytes]:
    """Return panoramas of other places: of the first other scene, or of a made room."""
    if scenes:
        return [read_panorama(query.image).rgb for query in clean_queries(scenes[0], 4)]
    world = make_world(63, np.array([5.0, 4.0, 2.6]))
    return [make_query(world, 0, "clean", 1024, Workers(num_cores())).rgb]


def time_ratio(rows: Sequence[QueryResult]) -> float:
    """Return the median seconds of the first label divided by those of the last."""
    first, last = (
        np.median([row.seconds for row in rows if row.variant == label])
        for label in (rows[0].variant, rows[-1].variant)
    )
    return float(first / last)


def wrong_lines(rows: Sequence[QueryResult]) -> str:
    """Return a line for each query that is localized and not right."""
    wrong = [row for row in rows if row.is_localized and not row.is_correct()]
    lines = [f"{len(wrong)} of {len(rows)} were localized and are not right."]
    for row in wrong[:MAX_WRONG]:
        error = f"{row.position_error:.2f} m off" if row.has_errors else "no right answer"
        lines.append(f"- {row.variant}, {row.image}: {error}; confidence {row.result.confidence:.3f}")
    if len(wrong) > MAX_WRONG:
        lines.append(f"- and {len(wrong) - MAX_WRONG} more")
    return "\n".join([*lines, ""])


def git_commit() -> str:
    """Return the commit of the checkout, with "-dirty" if files differ from it."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def processor_name() -> str:
    """Return the name of the processor, as far as the system knows it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def page_head(arguments: Arguments) -> str:
    """Return title, date, commit, options, versions and machine."""
    words = ["all", "--scenes", *(folder.resolve().name for folder in arguments.scenes)]
    for name in ("only", "damaged", "photos", "points", "rooms"):
        words += [f"--{name}", *map(str, np.atleast_1d(getattr(arguments, name)))]
    return HEAD.format(
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        commit=git_commit(),
        words=" ".join(words),
        python=platform.python_version(),
        numpy=np.__version__,
        numba=numba.__version__,
        opencv=cv2.__version__,
        processor=processor_name(),
        cores=num_cores(),
    )


def add_arguments(parser: ArgumentParser) -> None:
    """Add all options."""
    option(parser, "--scenes FOLDER ...", "scenes with true poses", required=True)
    option(parser, "--only PART ...", "measure only these parts", choices=PARTS, default=list(PARTS))
    option(parser, "--damaged N", "number of panoramas of each scene to damage", default=4)
    text = "number of phone photos to cut out of the panoramas of each scene"
    option(parser, "--photos N", text, default=12)
    sizes = [10_000, 100_000, 1_000_000]
    option(parser, "--points N ...", "sizes to which the first scene is resampled", nargs="*", default=sizes)
    text = "sizes of synthetic scenes, 1 to 256 rooms"
    option(parser, "--rooms N ...", text, nargs="*", default=[1, 16, 64])
    option(parser, "--out FILE", "write the page here (default: print it)")


def run(arguments: Arguments) -> int:
    """Measure, and write the page; beside BENCHMARK.md it writes the kernels with which that was made."""
    arguments.check_least(damaged=0, photos=0)
    head = page_head(arguments)
    kernels = list_lines(git_commit())
    bench = Bench(arguments)
    bench.measure()
    page = "\n".join(chain([head], bench.sections())).rstrip("\n") + "\n"
    if arguments.out is None:
        print(page, end="")
    else:
        write_atomically(arguments.out, page.encode())
        if Path(arguments.out).resolve() == PAGE:
            write_atomically(MEASURED, "".join(f"{line}\n" for line in kernels).encode())
    return 0
