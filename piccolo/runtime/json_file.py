"""Small text and JSON files, refused in one line that names them whatever is wrong with them."""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError, unreadable

Value = TypeVar("Value")
MAX_SIZE = 1 << 26  # [byte] of a file that is read whole
# what damaged JSON, or JSON of another kind, raises while it is parsed and its fields are read
DAMAGE = (AttributeError, IndexError, KeyError, OverflowError, RecursionError, TypeError, ValueError)


def read_bytes(path: Path, wanted: str, max_size: float = math.inf) -> bytes:
    """The content of a file of at most `max_size` bytes; `wanted` says in an error what it should hold."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a file but a folder or a device, {wanted}")
    try:
        if path.stat().st_size > max_size:
            raise InputError(f"{path}: found {path.stat().st_size} bytes, {wanted}")
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error) from error


def read_text(path: Path, wanted: str, max_size: int = MAX_SIZE) -> str:
    """The text of a UTF-8 file."""
    try:
        return read_bytes(path, wanted, max_size).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: found bytes that are no text, {wanted}") from error


def read_json(path: Path, wanted: str, max_size: int = MAX_SIZE) -> Any:
    """What a JSON file holds."""
    text = read_text(path, wanted, max_size)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # bad JSON, and numbers of thousands of digits
        raise InputError(f"{path}: found damaged JSON ({error}), {wanted}") from error


@contextmanager
def document_of(text: str, form: str, label: str) -> Iterator[Any]:
    """The JSON object in `text`, which says that it is of the format `form`; `label` begins an error.

    Within this, what damaged fields raise is an InputError too.
    """
    try:
        document = json.loads(text)
        if document["format"] != form:
            raise InputError(f"{label}: found format {document['format']!r}, wanted {form!r}")
        yield document
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(f"{label}: found {error!r}, wanted one JSON object of format {form!r}") from error


def parse_lines(path: Path, content: bytes, parse: Callable[[str], Value]) -> list[Value]:
    """`parse` of each line of a file's content that is not blank; an error names the file and the line."""
    values = []
    for number, line in enumerate(content.splitlines(), 1):
        try:
            if line.strip():
                values.append(parse(line.decode()))
        except DAMAGE as error:
            raise InputError(f"{path}, line {number}: {describe(error)}") from error
    return values


def describe(error: Exception) -> str:
    """What one of DAMAGE says: errors of our own in words, a missing key with its kind."""
    return str(error) if isinstance(error, ValueError) else repr(error)
