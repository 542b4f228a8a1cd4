"""Options that make no sense, and outputs that can't be written, are refused before any work."""

import math
import os
import stat
from argparse import Namespace
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputError
from ..files.atomic import check_output, is_stdout, is_stream
from ..panorama.cube import SUFFIXES

Outputs = Mapping[str, Path | None]  # by option; None where it is not given


class UsageError(InputError):
    """The options are wrong, whatever the files hold."""


@contextmanager
def checking_options() -> Iterator[None]:
    """Within this, an InputError is a UsageError."""
    try:
        yield
    except InputError as error:
        raise UsageError(str(error)) from error


def check_least(arguments: Namespace, **limits: float) -> None:
    """Refuse an option below its limit, by its name in `arguments`; one that is not there may be anything."""
    for name, limit in limits.items():
        value = getattr(arguments, name, None)
        if value is not None and not limit <= value < math.inf:
            raise UsageError(f"--{name.replace('_', '-')}: found {value}, wanted at least {limit}")


def refuse_given(arguments: Namespace, options: Sequence[str], why: str) -> None:
    """Refuse options without a default that are given, by their names in `arguments`."""
    for name in options:
        value = getattr(arguments, name)
        if value is not None and value is not False:
            raise UsageError(f"--{name.replace('_', '-')}: {why}")


def check_outputs(outputs: Outputs, inputs: Iterable[Path] = ()) -> None:
    """Refuse output files as check_distinct does (exit code 2), and those that can't be written (3)."""
    check_distinct(outputs, inputs)
    for path in filter(None, outputs.values()):
        check_output(path)


def check_distinct(outputs: Outputs, inputs: Iterable[Path] = ()) -> None:
    """Refuse outputs, files or folders, of which two are one or lie in each other, or one is an input.

    Links, also hard ones, count as what they lead to. An input folder stands for the pictures in it: the
    faces of a cube, or masks.
    """
    given = {name: path for name, path in outputs.items() if path and os.path.realpath(path) != os.devnull}
    earlier: dict[str, Path] = {}
    for name, path in given.items():
        for other, other_path in earlier.items():
            if _are_one(path, other_path):
                raise UsageError(f"{path}: found the same output as {other} for {name}, wanted two")
        earlier[name] = path
    existing = {identity: path for path in given.values() if (identity := _identity(path))}
    for file in _files_of(inputs) if existing else ():
        if (identity := _identity(file)) in existing:
            raise UsageError(f"{existing[identity]}: found an input as the output, wanted another name")


def _are_one(path: Path, other: Path) -> bool:
    """Return True if what is written to one would replace the other, or stands in it."""
    if is_stdout(path) or is_stdout(other):
        return is_stdout(path) and is_stdout(other)
    if path.exists() and other.exists() and path.samefile(other):
        return True
    real = Path(os.path.realpath(path))
    other_real = Path(os.path.realpath(other))
    return real.is_relative_to(other_real) or other_real.is_relative_to(real)


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of a regular file; None for all else."""
    try:
        status = path.stat()
    except (OSError, ValueError):  # of a name that no file can have
        return None
    return (status.st_dev, status.st_ino) if stat.S_ISREG(status.st_mode) else None


def _files_of(inputs: Iterable[Path]) -> Iterator[Path]:
    """Yield the inputs, of folders their pictures; those that can't be read are left to their readers."""
    for path in inputs:
        if os.path.isdir(path) and os.access(path, os.R_OK | os.X_OK):  # noqa: PTH112  # Path's raises for long
            yield from (file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
        else:
            yield path


def check_suffix(option: str, path: Path | None, suffixes: tuple[str, ...]) -> None:
    """Refuse an output whose name ends with none of the suffixes ("" is a folder's); a stream has none."""
    if path and not is_stream(path) and path.suffix.lower() not in suffixes:
        wanted = ", ".join(filter(None, suffixes)) + (", or a folder's name" if "" in suffixes else "")
        raise UsageError(f"{option} {path.name}: wanted a name that ends with {wanted}")


def check_folder_name(option: str, path: Path | None) -> None:
    """Refuse stdout and devices where a folder is wanted."""
    if path and is_stream(path):
        raise UsageError(f"{option} {path}: found stdout or a device, wanted a folder's name")
