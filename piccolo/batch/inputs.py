"""Inputs of a batch: photos by files, folders and names, and prior knowledge of them."""

import codecs
import csv
import math
import os
import re
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TextIO

from ..photo.panorama.cube import is_cube
from ..photo.photo import Photo, Prior, Vector
from ..scan_map.scan_map import ScanMap, check_within
from ..system.arguments import PICTURES
from ..system.errors import InputError, printable
from ..system.files.json_file import read_bytes, read_text

STDIN = "-"
WANTED_LIST = "wanted a text file, a photo's path on each line"
MAX_KINDS = 5  # kinds of files left out that a message names
GRAVITY = ("gravity_x", "gravity_y", "gravity_z")
COLUMNS = ("x", "y", "z", "radius", "heading", "tolerance", "height", *GRAVITY, "within")
NOT_WITHOUT = {"x": "y", "y": "x", "z": "x", "radius": "x", "tolerance": "heading"}
NOT_WITHOUT |= {"gravity_x": "gravity_y", "gravity_y": "gravity_z", "gravity_z": "gravity_x"}
BETWEEN_NAMES = ";"
WANTED = f"wanted a CSV file whose first line names its columns: name and any of {', '.join(COLUMNS)}"
DEFAULT_RADIUS = 5.0  # [m]
HEIGHT_TOLERANCE = 0.3  # [m] either side of a height
Row = tuple[Prior, Vector | None]  # prior of a photo, and its own direction of gravity if it has one


def is_from_stdin(words: Sequence[str]) -> bool:
    """Return True if names come on standard input, so that their number is not known."""
    return STDIN in words


def list_panoramas(
    words: Iterable[str], stdin: TextIO, left_out: Counter[str], is_panorama: Callable[[Path], bool] = is_cube
) -> Iterator[Path]:
    """Yield the panoramas that words name, in order: pictures, folders, `@list.txt`, `-` for stdin.

    A folder is one panorama if `is_panorama` says so (by default of a cube's six faces), else all pictures in
    it and in its folders, sorted by path; its other files are counted in `left_out` by suffix.
    Raises InputError if a list can't be read, or a folder holds no picture.
    """
    for word in words:
        if word == STDIN:
            with open(stdin.fileno(), "rb", buffering=0, closefd=False) as file:
                # Past Python's buffers: a thread that waits there for a name would hold their lock, without
                # which the program can't end.
                yield from _names(file)
        elif word.startswith("@"):
            content = read_bytes(Path(word[1:]), WANTED_LIST)
            yield from _names(content.removeprefix(codecs.BOM_UTF8).split(b"\n"))
        else:
            yield from _at(Path(word), left_out, is_panorama)


def _names(lines: Iterable[bytes]) -> Iterator[Path]:
    return (Path(os.fsdecode(line.rstrip(b"\r\n"))) for line in lines if line.strip())


def _at(path: Path, left_out: Counter[str], is_panorama: Callable[[Path], bool]) -> Iterator[Path]:
    if not os.path.isdir(path) or is_panorama(path):  # noqa: PTH112  # Path.is_dir raises for a long name
        yield path
        return
    found: list[Path] = []
    others = Counter[str]()
    for folder, is_one in _folders(path, is_panorama):
        if is_one:
            found.append(folder)
            continue
        files = [file for file in folder.iterdir() if file.name[0] != "." and not file.is_dir()]
        found += [file for file in files if file.suffix.lower() in PICTURES]
        others.update(file.suffix.lower() for file in files if file.suffix.lower() not in PICTURES)
    left_out.update(others)
    if not found:
        text = f"{path}: a folder without a JPEG, PNG, TIFF, WebP or HEIC picture"
        raise InputError("; ".join(filter(None, (text, describe_left_out(others)))))
    yield from sorted(found)


def _folders(top: Path, is_panorama: Callable[[Path], bool]) -> Iterator[tuple[Path, bool]]:
    """Yield a folder and the folders in it, each once, links last; and whether each is one panorama."""
    waiting = deque([top])
    seen = set[tuple[int, int]]()
    while waiting:
        folder = waiting.popleft()
        status = folder.stat()
        if (status.st_dev, status.st_ino) not in seen:
            seen.add((status.st_dev, status.st_ino))
            is_one = is_panorama(folder)
            yield folder, is_one
            for entry in () if is_one else folder.iterdir():
                if entry.is_dir():
                    (waiting.append if entry.is_symlink() else waiting.appendleft)(entry)


def describe_left_out(left_out: Counter[str]) -> str:
    """Describe how many files are left out, by kind; the text is empty if there are none."""
    kinds = sorted(left_out.items(), key=lambda kind: (-kind[1], kind[0]))[:MAX_KINDS]
    if rest := left_out.total() - sum(count for _, count in kinds):
        kinds.append(("of other kinds", rest))
    listed = ", ".join(f"{count} {printable(kind) or 'without a suffix'}" for kind, count in kinds)
    return f"{left_out.total()} files left out: {listed}" if kinds else ""


@dataclass(frozen=True)
class PriorTable:
    """Prior knowledge of single photos, by name; it replaces that of all photos."""

    path: Path
    by_name: Mapping[str, Row]
    used: set[str] = field(default_factory=set)

    def apply(self, photo: Photo, general: Prior) -> tuple[Photo, Prior]:
        """Return a photo and its prior, by the row of its path as given, or else of its file name."""
        name = photo.name if photo.name in self.by_name else photo.path.name
        self.used.add(name)
        prior, gravity_vector = self.by_name.get(name, (general, None))
        return replace(photo, gravity_vector=gravity_vector) if gravity_vector else photo, prior

    def check_scans(self, scan_map: ScanMap) -> None:
        """Refuse names that no scan of a map has."""
        for name, (prior, _) in self.by_name.items():
            try:
                check_within(scan_map, prior.within)
            except InputError as error:
                raise InputError(str(error).replace("`within`", f"{self.path}: within, of {name}")) from error


def _row_from(row: Mapping[str, float], within: tuple[str, ...], general: Prior) -> Row:
    """Return a row from numbers and names; `general` fills the fields that are not given."""
    changes: dict[str, Any] = {"within": within or general.within}
    if "x" in row:
        changes["near"] = (row["x"], row["y"], row.get("z"))
        changes["radius"] = row.get("radius", general.radius or DEFAULT_RADIUS)
    if "height" in row:
        changes["height"] = (row["height"] - HEIGHT_TOLERANCE, row["height"] + HEIGHT_TOLERANCE)
    if "heading" in row:
        changes["heading_deg"] = row["heading"]
        changes["heading_tolerance_deg"] = row.get("tolerance", general.heading_tolerance_deg)
    gravity_vector = None
    if "gravity_x" in row:
        x, y, z = (row[column] for column in GRAVITY)
        gravity_vector = Photo(Path(), gravity_vector=(x, y, z)).gravity_vector
    return replace(general, **changes), gravity_vector


def read_priors(path: Path, general: Prior) -> PriorTable:
    """Return the priors in a CSV file; cells may be empty, `general` then fills the field.

    Columns: name (the panorama's path as given, or its file name), x, y, z [m] in the scan's frame (without z
    in any height), radius [m] about them, heading [deg] of the image centre clockwise from +y, its tolerance
    [deg], height [m] above the floor, gravity_x, gravity_y, gravity_z (down, in the camera's axes, of any
    length), within (names of the map's scans, with semicolons between them). Between columns are commas, or
    semicolons or tabs; then numbers may have decimal commas. Of a table of given poses with names, such as
    NavVis' pano-poses.csv, the positions count.
    Raises InputError if the file can't be read, a cell is no number, or a row contradicts itself.
    """
    if (given := _read_positions(path, general)) is not None:
        return given
    lines = read_text(path, WANTED).splitlines()
    delimiter = next((mark for mark in "\t;" if lines and mark in lines[0]), ",")
    rows = csv.DictReader(lines, restkey="more", delimiter=delimiter)
    names = [name.strip().lower() for name in rows.fieldnames or ()]
    rows.fieldnames = names
    odd = sorted(set(names) - {"name", *COLUMNS})
    if "name" not in names or odd or len(set(names)) < len(names):
        found = f"found a column {odd[0]!r}" if "name" in names and odd else f"found the columns {names}"
        raise InputError(f"{path}: {found}, {WANTED}")
    by_name: dict[str, Row] = {}
    for cells in rows:
        row = dict(cells)
        where = f"{path}, line {rows.line_num}"
        name = (row.pop("name") or "").strip()
        if "more" in row:
            raise InputError(f"{where}: found more cells than columns")
        if not name or name in by_name:
            raise InputError(f"{where}: found {f'the name {name!r} twice' if name else 'no name'}")
        within = (row.pop("within", None) or "").split(BETWEEN_NAMES)
        if delimiter != ",":
            row = {column: cell and cell.replace(",", ".") for column, cell in row.items()}
        numbers = _numbers(where, row)
        try:
            by_name[name] = _row_from(numbers, tuple(w.strip() for w in within if w.strip()), general)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
    return PriorTable(path, by_name)


def _read_positions(path: Path, general: Prior) -> PriorTable | None:
    """Return priors by the positions in a table of given poses; None if the file is not such a table."""
    from ..poses.pose_table import read_pose_table  # noqa: PLC0415  # it imports scipy, which takes long

    try:
        table = read_pose_table(path)
    except InputError:
        return None
    names = table.column("name")
    if names is None or not table.head or any(re.search(r"\bname\b", line.lower()) for line in table.head):
        return None
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"{path}: found the name {twice[0]!r} twice")
    table.check_metres()
    centers = [dict(zip("xyz", pose.center_world.tolist(), strict=True)) for pose in table.poses]
    rows = zip(names, centers, strict=True)
    return PriorTable(path, {name: _row_from(center, (), general) for name, center in rows})


def _numbers(where: str, row: Mapping[str, str | None]) -> dict[str, float]:
    """Return the cells that are not empty, as finite numbers."""
    numbers = {}
    for column, text in row.items():
        if text is None or not text.strip():
            continue
        try:
            numbers[column] = float(text)
        except ValueError as error:
            raise InputError(f"{where}: found {column} {text.strip()!r}, wanted a number") from error
        if not math.isfinite(numbers[column]):
            raise InputError(f"{where}: found {column} {text.strip()}, wanted a finite number")
    for column, other in NOT_WITHOUT.items():
        if column in numbers and other not in numbers:
            raise InputError(f"{where}: found {column} without {other}")
    return numbers
