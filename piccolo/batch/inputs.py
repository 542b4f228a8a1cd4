"""The panoramas of a batch: pictures, folders of pictures, lists, and names that come on standard input."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TextIO

from ..errors import InputError
from ..panorama.cube import SUFFIXES, is_cube
from ..runtime.json_file import read_text

STDIN = "-"
WANTED_LIST = "wanted a text file, a panorama's path on each line"


def is_from_stdin(words: Sequence[str]) -> bool:
    """True if names come on standard input, so that nobody knows how many."""
    return STDIN in words


def panoramas_of(
    words: Iterable[str], stdin: TextIO, is_panorama: Callable[[Path], bool] = is_cube
) -> Iterator[Path]:
    """The panoramas that words name, in order: a picture, a folder, `@list.txt`, or `-` for lines of `stdin`.

    A folder is one panorama if it holds the six faces of a cube, or what else `is_panorama` tells, else all
    pictures in it and in its folders, sorted by path.

    Raises
    ------
    InputError
        A list can't be read, or a folder holds no picture.
    """
    for word in words:
        if word == STDIN:
            yield from _lines(stdin)
        elif word.startswith("@"):
            lines = read_text(Path(word[1:]), WANTED_LIST).splitlines()
            yield from (Path(line) for line in lines if line.strip())
        else:
            yield from _at(Path(word), is_panorama)


def _lines(stdin: TextIO) -> Iterator[Path]:
    """The names on standard input, read past Python's buffers.

    A thread that waits there for a name would hold their lock, without which the program can't end.
    """
    with open(stdin.fileno(), "rb", buffering=0, closefd=False) as file:
        yield from (Path(os.fsdecode(line.rstrip(b"\r\n"))) for line in file if line.strip())


def _at(path: Path, is_panorama: Callable[[Path], bool]) -> Iterator[Path]:
    if not path.is_dir() or is_panorama(path):
        yield path
        return
    folders = [path, *(folder for folder in path.rglob("*") if folder.is_dir())]
    whole = [folder for folder in folders if is_panorama(folder)]
    files = (
        file
        for folder in folders
        if not any(folder.is_relative_to(other) for other in whole)
        for file in folder.iterdir()
    )
    pictures = [file for file in files if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")]
    if not pictures and not whole:
        raise InputError(f"{path}: a folder without a JPEG, PNG, TIFF or WebP picture")
    yield from sorted([*pictures, *whole])
