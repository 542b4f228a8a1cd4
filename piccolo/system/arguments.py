"""Values that options may have, for those who show and who read them; checks against annotations."""

import inspect
import types
from collections.abc import Callable, Iterable, Mapping, Sequence, Sized
from dataclasses import fields
from os import PathLike
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np

from .errors import InputError

Projection = Literal["equirectangular", "pinhole", "fisheye", "cylindrical"]
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".heic", ".heif", ".insp")  # suffixes
EXIF = "exif"  # sources of the times of a walk's frames
NAMES = "names"
ORDER = "order"
MAX_SPEED = 2.0  # [m/s] of a walking person with a camera
MAX_STEP = 5.0  # [m] from one frame without time to the next
MIN_CONFIDENCE = 0.9  # from which a pose is localized
WORDS = {
    str: "a text",
    PathLike: "a path",
    types.NoneType: "None",
    bool: "True or False",
    int: "a whole number",
    float: "a number",
}
NUMBERS = {bool: bool | np.bool_, int: int | np.integer, float: float | int | np.floating | np.integer}


def check_fields(options: Any) -> None:
    """Check the fields of a frozen dataclass against its annotations, when it is made.

    NumPy scalars become Python numbers, and rows of numbers tuples. Raises InputError for another type.
    """
    kinds = inspect.get_annotations(type(options))
    for name in [f.name for f in fields(options) if f.name in kinds]:
        object.__setattr__(options, name, check_kind(name, getattr(options, name), kinds[name]))


def check_kind(name: str, value: Any, kind: Any) -> Any:
    """Return the value of an option, plain; InputError if it is not of an annotated type."""
    if not is_of_kind(value, kind):
        raise InputError(f"`{name}`: found {describe_value(value)}, wanted {describe(kind)}")
    return plain(value, kind)


def is_of_kind(value: object, kind: Any) -> bool:
    """Return True if a value is of an annotated type. The dtype of an array is not checked."""
    origin = get_origin(kind) or kind
    parts = get_args(kind)
    if origin in (Union, types.UnionType):
        return any(is_of_kind(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if kind in NUMBERS:
        return isinstance(value, NUMBERS[kind]) and (kind is bool or not isinstance(value, bool))
    if parts and origin is not np.ndarray:
        return callable(value) if origin is Callable else is_collection(value, origin, parts)
    return isinstance(value, origin)


def is_collection(value: Any, origin: Any, parts: tuple[Any, ...]) -> bool:
    """Return True if a value is of an annotated collection type. Items of an iterator are not read."""
    if isinstance(value, str | bytes):
        return False
    if origin is tuple:
        is_row = isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.ndim == 1)
        return (
            is_row
            and len(value) == len(parts)
            and all(is_of_kind(v, p) for v, p in zip(value, parts, strict=True))
        )
    if not isinstance(value, origin):
        return False
    if isinstance(value, Mapping):
        return all(is_of_kind(item, parts[1]) for item in value.values())
    return not isinstance(value, Sequence) or all(is_of_kind(item, parts[0]) for item in value)


def describe(kind: Any) -> str:
    """Describe an annotated type in words."""
    origin = get_origin(kind) or kind
    parts = get_args(kind)
    if origin in (Union, types.UnionType):
        words = dict.fromkeys(describe(part) for part in parts if part is not types.NoneType)
        if "a path" in words:
            words.pop("a text", None)
        return " or ".join(words)
    if origin is Literal:
        return f"one of {', '.join(parts)}"
    if origin is tuple:
        return f"{len(parts)} numbers" if float in parts else f"{len(parts)} values"
    if origin in (Sequence, Iterable):
        return f"a list, each {describe(parts[0])}"
    if origin is np.ndarray:
        return "an array"
    return WORDS.get(origin, "a function" if origin is Callable else origin.__name__)


def describe_value(value: object) -> str:
    """Return a value as text for a message: of an array, dtype and shape."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype} of shape {value.shape}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def plain(value: Any, kind: Any) -> Any:
    """Convert a NumPy scalar to a Python number, and a list or array to a tuple if a tuple is annotated."""
    origin = get_origin(kind)
    kinds = get_args(kind) if origin in (Union, types.UnionType) else (kind,)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | np.ndarray | tuple) and any(get_origin(k) is tuple for k in kinds):
        return tuple(item.item() if isinstance(item, np.generic) else item for item in value)
    return value


def check_one_each(name: str, values: Sized | None, count: int, what: str) -> None:
    """Refuse an argument that is not a value of each of several photos."""
    if values is not None and len(values) != count:
        raise InputError(f"`{name}`: found {len(values)} of {count} {what}s, wanted one of each {what}")


def check_confidence(min_confidence: float) -> None:
    """Refuse a threshold that no confidence can pass or fail."""
    if not 0.0 < min_confidence < 1.0:
        raise InputError(f"`min_confidence`: found {min_confidence}, wanted above 0 and below 1")
