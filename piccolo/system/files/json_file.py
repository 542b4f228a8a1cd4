"""Small text and JSON files, refused in one line that names them whatever is wrong with them."""

import json
import math
import stat
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError, unreadable

Value = TypeVar("Value")
MAX_JSON_SIZE = 1 << 26  # [byte] of a file that is read whole
# what damaged JSON, or JSON of another kind, raises while it is parsed and its fields are read
DAMAGE = (AttributeError, IndexError, KeyError, OverflowError, RecursionError, TypeError, ValueError)

_held: ContextVar[dict[Path, bytes] | None] = ContextVar("held", default=None)  # contents, by `reading_once`


def read_bytes(path: Path, wanted: str, max_size: float = math.inf) -> bytes:
    """Return a file's content, at most `max_size` bytes; `wanted` says in an error what it should hold."""
    held = _held.get()
    if held is not None and path in held:
        return held[path]
    try:
        status = path.stat()
        is_right = stat.S_ISREG(status.st_mode) and status.st_size <= max_size
        content = path.read_bytes() if is_right else b""
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: not a file but a folder or a device, {wanted}")
    if not is_right:
        raise InputError(f"{path}: found {status.st_size} bytes, {wanted}")
    if held is not None:
        held[path] = content
    return content


@contextmanager
def reading_once() -> Iterator[None]:
    """Within this, the content of a file is read from the disk once, so that all that is said is of one.

    Nested ones share what was read. It is let go where one of them ends, but kept for those around it if that
    was by an error.
    """
    held = _held.get()
    held = {} if held is None else held
    token = _held.set(held)
    try:
        yield
        held.clear()
    finally:
        _held.reset(token)


def read_text(path: Path, wanted: str, max_size: int = MAX_JSON_SIZE) -> str:
    """Return the text of a UTF-8 file, or of one in UTF-16 with a mark."""
    content = read_bytes(path, wanted, max_size)
    try:
        return content.decode("utf-16" if content[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: found bytes that are no text, {wanted}") from error


def read_json(path: Path, wanted: str) -> Any:
    """Return what a JSON file holds."""
    text = read_text(path, wanted)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # bad JSON, and numbers of thousands of digits
        raise InputError(f"{path}: found damaged JSON ({error}), {wanted}") from error


@contextmanager
def reading_document(text: str, form: str, label: str) -> Iterator[Any]:
    """Yield the JSON object in `text`, which says that it is of the format `form`; `label` begins an error.

    Within this, what damaged fields raise is an InputError too.
    """
    try:
        document = json.loads(text)
        found = document.get("format") if isinstance(document, dict) else None
        if found != form:
            words = "no format" if found is None else f"format {found!r}"
            raise InputError(f"{label}: found {words}, wanted {form!r}")
        yield document
    except InputError:
        raise
    except DAMAGE as error:
        found = repr(error).replace("`", "")  # of msgspec: in messages they are around options
        raise InputError(f"{label}: found {found}, wanted one JSON object of format {form!r}") from error


@contextmanager
def naming(path: Path, wanted: str) -> Iterator[None]:
    """Within this, the error of a part of a file is an InputError that names the file and what is wanted."""
    try:
        yield
    except InputError as error:
        if str(error).startswith((f"{path}: ", f"{path}, ")):
            raise
        mark = ":" if str(error).startswith("found") else ","  # behind which the part is named
        raise InputError(f"{path}{mark} {error}; {wanted}") from error
    except DAMAGE as error:
        raise InputError(f"{path}: found {describe_damage(error)}, {wanted}") from error


def parse_lines(path: Path, content: bytes, parse: Callable[[str], Value]) -> list[Value]:
    """`parse` of each line of a file's content that is not blank; an error names the file and the line."""
    values = []
    for number, line in enumerate(content.splitlines(), 1):
        try:
            if line.strip():
                values.append(parse(line.decode()))
        except DAMAGE as error:
            raise InputError(f"{path}, line {number}: {describe_damage(error)}") from error
    return values


def describe_damage(error: Exception) -> str:
    """Return what one of DAMAGE says, in words."""
    if isinstance(error, KeyError):
        return f"no field {str(error.args[0])[:40]!r}"
    return str(error) if isinstance(error, ValueError) else "fields of another kind"


def is_number(field: str) -> bool:
    """Return True if np.loadtxt reads a field as a number."""
    try:
        float(field)
    except ValueError:
        return False
    return "_" not in field  # which Python takes and np.loadtxt does not
