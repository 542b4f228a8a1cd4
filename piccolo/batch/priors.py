"""Prior knowledge of each camera, from a table."""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files.json_file import read_text
from ..photo import Photo, Prior, Vector
from ..scan_map.scan_map import ScanMap, check_within

GRAVITY = ("gravity_x", "gravity_y", "gravity_z")
COLUMNS = ("x", "y", "z", "radius", "heading", "tolerance", "height", *GRAVITY, "within")
NOT_WITHOUT = {"x": "y", "y": "x", "z": "x", "radius": "x", "tolerance": "heading"}
NOT_WITHOUT |= {"gravity_x": "gravity_y", "gravity_y": "gravity_z", "gravity_z": "gravity_x"}
BETWEEN_NAMES = ";"
WANTED = f"wanted a CSV file whose first line names its columns: name and any of {', '.join(COLUMNS)}"
DEFAULT_RADIUS = 5.0  # [m]
HEIGHT_TOLERANCE = 0.3  # [m] either side of a height
Row = tuple[Prior, Vector | None]  # with the direction of gravity, in place of that of all photos


@dataclass(frozen=True)
class PriorTable:
    """Prior knowledge of single photos, by name; it goes before that of all."""

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
                text = str(error).replace("`within`", f"{self.path}: within, of {name}")
                raise InputError(text) from error

    @property
    def names_without_panorama(self) -> list[str]:
        """Names in the table that no panorama has had."""
        return [name for name in self.by_name if name not in self.used]


def _row_from(row: Mapping[str, float], within: tuple[str, ...], general: Prior) -> Row:
    """Return a row of numbers and names; `general` fills what they leave open."""
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
    """Return the priors in a CSV file; cells may be empty, `general` fills what they leave open.

    Columns: name (the panorama's path as given, or its file name), x, y, z [m] in the scan's frame (without z
    in any height), radius [m] about them, heading [deg] of the image centre clockwise from +y, its tolerance
    [deg], height [m] above the floor, gravity_x, gravity_y, gravity_z (down, in the camera's axes, of any
    length), within (names of the map's scans, with semicolons between them). Between columns are commas, or
    semicolons or tabs; then numbers may have decimal commas.
    Raises InputError if the file can't be read, a cell is no number, or a row contradicts itself.
    """
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
