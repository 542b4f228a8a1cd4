"""Results of a batch, a line a panorama: on a stream, or in a file from which a stopped batch goes on."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from ..api.values import FAILED, FORMAT, Result
from ..system.errors import InputError
from ..system.files.line_file import LineFile, whole_lines, whole_size
from ..together.second_looks import may_change

LINE_BEGINS = f'{{"format": "{FORMAT}"'.encode()
WAYS = "use `overwrite` to start again, or another `out`"
GROUPS = ("prior", "cloud", "panorama")  # groups of settings, all of which are options
OPTIONS = ("preset", "gravity", "accuracy", "min_confidence")  # further settings that are options
RENAMED = {"scale": "units"}
Name = TypeVar("Name", Path, str)


def _fields_of(line: bytes, where: str) -> dict[str, Any]:
    """Return the fields of a whole line that an earlier run has left."""
    try:
        fields = json.loads(line)
        found = fields["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{where}: not a result of localize.py; {WAYS}") from error
    if found != FORMAT:
        raise InputError(f"{where}: found format {found!r}, wanted {FORMAT!r}; {WAYS}")
    return {**fields, "line": where}


def check_as_expected(fields: Mapping[str, Any], expected: Mapping[str, Any], ways: str = WAYS) -> None:
    """Refuse a finished line, `fields["line"]`, that was not made with the expected scan and settings."""
    different = next((key for key in expected if fields.get(key) != expected[key]), None)
    if different is None:
        return
    found = fields.get(different)
    text = f"made with {different} {found!r}, not {expected[different]!r}"
    if different == "settings" and isinstance(found, dict):
        text = f"made {describe_changes(found, expected[different])}"
    if different == "cloud_sha256":
        text = "made with another scan, or the scan has changed since"
    raise InputError(f"{fields['line']}: {text}; {ways}")


def describe_changes(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Describe how settings differ, by the names of the options."""
    old = _by_option(found)
    new = _by_option(wanted)
    names = sorted(name for name in {*old, *new} if old.get(name) != new.get(name))
    names = ["`preset`"] if "`preset`" in names else names
    return "; ".join(f"{_say(k, old.get(k), 'with ')}, now {_say(k, new.get(k))}" for k in names)


def _by_option(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the value of each setting by the name of its option in backticks, or else by its own name."""
    values = {name: settings[name] for name in settings if name not in (*GROUPS, "method")}
    if "accuracy" in values:
        values["accuracy"] = list(values["accuracy"].values())
    values |= settings.get("method", {})  # no option sets its numbers
    values = {f"`{name}`" if name in OPTIONS else name: value for name, value in values.items()}
    grouped = {name: value for group in GROUPS for name, value in settings.get(group, {}).items()}
    return values | {f"`{RENAMED.get(name, name)}`": value for name, value in grouped.items()}


def _say(name: str, value: Any, given: str = "") -> str:
    """Describe the value of an option, such as "`focal_px` 1585" or "without `focal_px`"."""
    if isinstance(value, dict):
        value = value.get("path", True)  # the file of a calibration
    if value in (None, False, []):
        return f"without {name}"
    if value is True:
        return f"{given}{name}"
    parts = value if isinstance(value, list) else [value]
    return f"{given}{name} {' '.join(f'{p:.10g}' if isinstance(p, float) else str(p) for p in parts)}"


class Finished(NamedTuple):
    """A line that an earlier run has left."""

    span: tuple[int, int]  # [byte] in the file
    pano_sha256: str | None
    status: str
    is_second: bool  # it replaces an earlier line, as the photo was localized again


class Records:
    """The panoramas that have results in a file, and the order that the lines are to have at the end."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self.size = 0  # [byte] of the lines of earlier runs
        self.order: list[Finished | None] = []  # lines of the panoramas so far; None for those of this run
        self._others: dict[str, list[Finished]] = {}  # by panorama: lines that are not in the order
        self._named: set[str] = set()

    @property
    def counts(self) -> Counter[str]:
        """Number of results of earlier runs that are kept, by status."""
        return Counter(line.status for line in self.order if line)

    @property
    def is_in_order(self) -> bool:
        """True if the file has the lines of the panoramas so far, in their order, and no others."""
        spans = [line.span for line in self.order if line]
        return spans == sorted(spans) and len(spans) == len(self.order) and not any(self._others.values())

    def read(
        self, expected: Callable[[Path], Mapping[str, Any]], panoramas: Iterable[Path | str] | None
    ) -> None:
        """Read the lines that earlier runs have left.

        Raises InputError if a line was made with other settings than its panorama has now, or if no line is
        of one of the `panoramas` to come (None: they are not known).
        """
        if self.path is None:
            return
        named = None if panoramas is None else set(map(str, panoramas))
        whole = whole_size(self.path, LINE_BEGINS, f"results of localize.py: {WAYS}")
        for number, content in enumerate(whole_lines(self.path, whole), 1):
            fields = _fields_of(content, f"{self.path}, line {number}")
            pano = str(fields.get("pano"))
            if named is None or pano in named:
                check_as_expected(fields, expected(Path(pano)))
            span = (self.size, self.size + len(content))
            focal = fields.get("focal_length") or {}
            is_second = fields.get("beside") is not None or focal.get("others_px") is not None
            line = Finished(span, fields.get("pano_sha256"), str(fields.get("status")), is_second)
            self._others.setdefault(pano, []).append(line)
            self.size = span[1]
        if self._others and named is not None and named.isdisjoint(self._others):
            raise InputError(f"{self.path}: it has no result of the photos given; {WAYS}")

    def remaining(
        self, panoramas: Iterable[Name], compute_digest: Callable[[Name], str | None]
    ) -> Iterator[Name]:
        """Yield the panoramas that have no result, in their order.

        A panorama has a result if its line did not fail, and its file has the same digest or can't be read
        now.
        """
        for pano in panoramas:
            lines = self._others.get(str(pano), [])
            taken = None
            if lines:
                self._named.add(str(pano))
                digest = compute_digest(pano)
                newest = sorted(lines, key=lambda line: not line.is_second)
                same = (line for line in newest if digest in (None, line.pano_sha256))
                taken = next((line for line in same if line.status != FAILED), None)
            self.order.append(taken)
            if taken is None:
                yield pano
            else:
                lines.remove(taken)

    def list_unnamed(self) -> list[Finished]:
        """List the lines of panoramas that were not named, without lines that another line replaces."""
        found = []
        for lines in (self._others[name] for name in self._others.keys() - self._named):
            has_second = any(line.is_second for line in lines)
            found += list({line.pano_sha256: line for line in lines}.values()) if has_second else lines
        return found


class StreamOutput:
    """Lines on a stream, in the order of the photos; a line that may change holds back those behind it."""

    def __init__(self, write: Callable[[str], object], may_change: bool) -> None:
        self._write = write
        self._may_change = may_change
        self._is_waiting = False
        self._num_written = 0
        self._texts: list[str] = []

    def write(self, text: str) -> None:
        """Write a photo's line, or keep it until the lines before it are final."""
        if not self._may_change:
            self._write(text)
            return
        self._texts.append(text)
        self._is_waiting = self._is_waiting or may_change(Result.from_json(text))
        if not self._is_waiting:
            self.close()

    def results(self) -> list[Result]:
        """Return the results so far."""
        return list(map(Result.from_json, self._texts))

    def replace(self, number: int, text: str) -> None:
        """Replace a photo's line."""
        self._texts[number] = text

    def close(self) -> None:
        """Write the lines that waited."""
        while self._num_written < len(self._texts):
            self._num_written += 1
            self._write(self._texts[self._num_written - 1])


class FileOutput:
    """Lines in a file, each at once on disk; replaced lines are dropped and all put in order at the end."""

    def __init__(self, file: LineFile, records: Records) -> None:
        self._file = file
        self._records = records
        self._replaced: dict[int, tuple[int, int]] = {}  # span [byte] of the newer line of a photo

    def begin(self) -> None:
        """Cut off an incomplete last line of an earlier run, before the first line is appended."""
        self._file.cut(self._records.size)

    def write(self, text: str) -> None:
        """Append a photo's line."""
        self._file.append(text)

    def _spans(self) -> list[tuple[int, int]]:
        """Return the span [byte] of each panorama's newest line, in the order of the panoramas.

        The lines of this run stand behind those of earlier runs.
        """
        begin = self._records.size
        new_lines = whole_lines(self._file.path, self._file.size, begin)
        new_spans = pairwise(accumulate(map(len, new_lines), initial=begin))
        spans = [line.span if line else next(new_spans) for line in self._records.order]
        return [self._replaced.get(k, span) for k, span in enumerate(spans)]

    def results(self) -> list[Result]:
        """Return the results of the photos so far, in their order."""
        return [Result.from_json(self._file.read(*span).decode()) for span in self._spans()]

    def replace(self, number: int, text: str) -> None:
        """Append a line that is to replace the line of a photo, given by its number in the order."""
        begin = self._file.size
        self._file.append(text)
        self._replaced[number] = begin, self._file.size

    def finish(self, keeps_others: bool) -> int:
        """Put the lines of the panoramas into their order, and drop the lines that were replaced.

        Lines of panoramas that were not named are kept before all others, or dropped. Returns how many were
        dropped.
        """
        others = self._records.list_unnamed()
        kept = sorted(line.span for line in others) if keeps_others else []
        self._file.rearrange([*kept, *self._spans()])
        return 0 if keeps_others else len(others)


Output = StreamOutput | FileOutput
