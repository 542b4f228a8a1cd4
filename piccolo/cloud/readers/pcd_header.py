"""The header of PCD files: lines of a name and its values, the last of them DATA."""

from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError
from .reader import quoted

MAX_HEADER_SIZE = 1 << 16  # [byte]
MAX_COUNT_DIGITS = 10
MAX_ROW_SIZE = 1 << 16  # [byte] of a point
ENCODINGS = ("ascii", "binary", "binary_compressed")
WANTED = "wanted a PCD file with the fields x y z and rgb, rgba or r g b"


@dataclass(frozen=True)
class PcdField:
    """One of a point's fields."""

    name: str
    type: str  # NumPy's, without byte order: all numbers are little-endian
    count: int  # numbers
    offset: int  # [byte] in a point
    column: int  # of its first number among those of a point

    @property
    def size(self) -> int:
        """Bytes of all its numbers."""
        return int(self.type[1:]) * self.count


@dataclass(frozen=True)
class PcdHeader:
    """The header of a PCD file."""

    path: Path
    fields: tuple[PcdField, ...]
    num_points: int
    encoding: str  # one of ENCODINGS
    size: int  # [byte], the data begin here

    @property
    def row_size(self) -> int:
        """Bytes of a point in binary."""
        return sum(field.size for field in self.fields)

    @property
    def num_columns(self) -> int:
        """Numbers of a point."""
        return sum(field.count for field in self.fields)


def read_header(path: Path) -> PcdHeader:
    """The header of a PCD file; SIZE, TYPE and COUNT may be missing, as in old ones: 4, F and 1."""
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_SIZE)
    entries: dict[str, list[str]] = {}
    size = 0
    for line in head.split(b"\n"):
        size += len(line) + 1
        words = line.decode("latin-1").split()
        if words and not words[0].startswith("#"):
            entries["FIELDS" if words[0] == "COLUMNS" else words[0]] = words[1:]
        if "DATA" in entries:
            break
    if not {"FIELDS", "DATA"} <= entries.keys():
        raise InputError(f"{path}: the header has no lines FIELDS and DATA, {WANTED}")
    encoding = " ".join(entries["DATA"])
    if encoding not in ENCODINGS:
        raise InputError(f"{path}: DATA is {quoted(encoding.encode())}, wanted {', '.join(ENCODINGS)}")
    fields = _fields(path, entries)
    return PcdHeader(path, fields, _num_points(path, entries), encoding, min(size, len(head)))


def _fields(path: Path, entries: dict[str, list[str]]) -> tuple[PcdField, ...]:
    names = entries["FIELDS"]
    usual = {"SIZE": "4", "TYPE": "F", "COUNT": "1"}
    sizes, types, counts = (entries.get(key, [value] * len(names)) for key, value in usual.items())
    if not len(names) == len(sizes) == len(types) == len(counts):
        found = f"{len(names)} FIELDS, {len(sizes)} of SIZE, {len(types)} of TYPE and {len(counts)} of COUNT"
        raise InputError(f"{path}: the header has {found}, wanted as many of each")
    fields: list[PcdField] = []
    offset = column = 0
    for name, size, type_, text in zip(names, sizes, types, counts, strict=True):
        count = _count(text)
        if size not in ("1", "2", "4", "8") or type_ not in ("I", "U", "F") or not count:
            found = quoted(f"{name} {size} {type_} {text}".encode())
            wanted = "wanted SIZE 1 2 4 or 8, TYPE I U or F, COUNT 1 or more"
            raise InputError(f"{path}: a field has the name, SIZE, TYPE and COUNT {found}, {wanted}")
        fields.append(PcdField(name, type_.lower() + size, count, offset, column))
        offset += fields[-1].size
        column += count
    if offset > MAX_ROW_SIZE:
        raise InputError(f"{path}: the header promises {offset} bytes a point, wanted {MAX_ROW_SIZE} at most")
    return tuple(fields)


def _num_points(path: Path, entries: dict[str, list[str]]) -> int:
    """POINTS, or WIDTH x HEIGHT; both must be the same if both are there."""
    found = {key: entries[key] for key in ("WIDTH", "HEIGHT", "POINTS") if key in entries}
    counts = {key: _count(" ".join(words)) for key, words in found.items()}
    if None in counts.values() or not counts.keys() & {"POINTS", "WIDTH"}:
        words = " ".join(f"{key} {' '.join(words)}" for key, words in found.items())
        raise InputError(f"{path}: the header counts the points by {quoted(words.encode())}, {WANTED}")
    num_cells = (counts.get("WIDTH") or 0) * (counts.get("HEIGHT", 1) or 0)
    num_points = counts.get("POINTS", num_cells) or 0
    if "WIDTH" in counts and num_cells != num_points:
        raise InputError(f"{path}: the header promises {num_points} points in a grid of {num_cells}")
    return num_points


def _count(text: str) -> int | None:
    return int(text) if text.isdecimal() and len(text) <= MAX_COUNT_DIGITS else None
