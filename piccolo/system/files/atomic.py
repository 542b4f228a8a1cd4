"""Files that are either whole or not there, their locks, and what else a path of the user's may lead to.

A later process removes temporary folders where a killed one left them.
"""

import errno
import json
import os
import secrets
import shutil
import stat
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO

from ..errors import InputError
from .lock import lock_descriptor

Errors = type[Exception] | tuple[type[Exception], ...]
STDOUT = Path("-")
WRITE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EPIPE}  # that name no file
PREFIX = "piccolo-temporary-"
YOUNG_S = 10.0  # a folder is made a moment before it is locked
IS_WINDOWS = sys.platform == "win32"
ROOM = 1 << 16  # [byte] that must fit behind a whole file; more than a block of any file system
WAITS_S = (0.01, 0.1, 0.5) if IS_WINDOWS else ()  # which replaces no file that somebody reads, for a moment


def is_stdout(path: Path) -> bool:
    """Return True for -, /dev/stdout, and any other name of what stdout is; not for /dev/null."""
    with suppress(OSError):  # there is no such file, or no stdout
        if sys.stdout is not None and os.path.samestat(path.stat(), os.fstat(1)):
            return os.path.realpath(path) != os.devnull
    return path == STDOUT


def is_stream(path: Path) -> bool:
    """Return True for what is written to as it is: stdout, a FIFO or a character device."""
    return is_stdout(path) or path.is_fifo() or path.is_char_device()


def check_output(path: Path) -> None:
    """Refuse, before any work is done, a file that could not be written."""
    if is_stream(path):
        if path.exists() and not os.access(path, os.W_OK):
            raise InputError(f"{path}: found no write permission, wanted a device that can be written")
        return
    _check_folder_of(path)
    if path.is_dir():
        raise InputError(f"{path}: found a folder, wanted a file name")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: found a socket or a disk, wanted a file name")
    if path.exists() and not os.access(path, os.W_OK):
        raise InputError(f"{path}: found a file without write permission, wanted another name")


def check_output_folder(path: Path) -> None:
    """Refuse, before any work is done, a folder that could not be made or that has something in it."""
    if is_stream(path):
        raise InputError(f"{path}: found stdout or a device, wanted a folder that is new or empty")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        kind = "a folder that is not empty" if path.is_dir() else "a file"
        raise InputError(f"{path}: found {kind}, wanted a folder that is new or empty")
    _check_folder_of(path)


def _check_folder_of(path: Path) -> None:
    """Refuse a path where nothing can be made: the folder that counts is that of a link's target."""
    folder = _target_of(path).parent
    if not folder.is_dir():
        raise InputError(f"{path}: found no folder {folder}, wanted one that exists")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{path}: found {folder} without write permission, wanted one that can be written")


def _target_of(path: Path) -> Path:
    """Return the file that a path stands for, there or not: of a link its target, which is replaced."""
    if not path.is_symlink():
        return path
    try:
        return Path(os.path.realpath(path, strict=True))
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise InputError(f"{path}: found a link that leads to itself, wanted another name") from error
        return Path(os.path.realpath(path))


def temporary_prefix(name: str) -> str:
    """Return the beginning of a file's temporary names; 16 hexadecimal digits follow."""
    return f".{name[:40]}."


@contextmanager
def _in_place_of(path: Path) -> Iterator[tuple[Path, Path]]:
    """Yield a path's target, and a name beside it, which takes its place at the end; gone after an error."""
    target = _target_of(path)
    temporary = target.with_name(temporary_prefix(target.name) + secrets.token_hex(8))
    try:
        with naming_written(path, temporary):
            yield target, temporary
            for wait in WAITS_S:
                with suppress(PermissionError):
                    temporary.replace(target)
                    return
                time.sleep(wait)
            temporary.replace(target)
    except BaseException:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Yield a file to write and to seek in, under a temporary name in the same folder, renamed at the end.

    Nobody sees half a file, and after an error nothing is left. An existing file gives its mode and owner to
    the new one; its other hard links keep the old content. What is_stream gets the whole content at the end.
    """
    if is_stream(path):
        with naming_written(path), tempfile.TemporaryFile() as file:
            yield file
            file.seek(0)
            _write_stream(path, file)
        return
    with _in_place_of(path) as (target, temporary), _open_like(target, temporary) as file:
        yield file


@contextmanager
def _open_like(target: Path, temporary: Path) -> Iterator[IO[bytes]]:
    """Yield a new file, which at the end has the mode and owner of the target, if that exists."""
    old = target.stat() if target.exists() else None
    mode = stat.S_IMODE(old.st_mode) if old else 0o666
    with open(temporary, "x+b", opener=partial(os.open, mode=mode)) as file:
        yield file
        file.flush()
        if old and not IS_WINDOWS:
            with suppress(PermissionError):  # where that is not allowed
                os.fchown(file.fileno(), old.st_uid, old.st_gid)
            os.fchmod(file.fileno(), mode)
        # It takes milliseconds. File systems that write late (NFS, quotas) say only now that there is
        # no room, and after a power cut the new name might stand for an empty file.
        os.fsync(file.fileno())


def _write_stream(path: Path, file: IO[bytes]) -> None:
    """Copy a file to stdout, a FIFO (which waits for a reader) or a device."""
    if not is_stdout(path):
        with path.open("wb") as stream:
            shutil.copyfileobj(file, stream)
        return
    if sys.stdout is None:
        raise InputError(f"{path}: found a closed stdout, wanted an open one or a file")
    sys.stdout.flush()
    shutil.copyfileobj(file, sys.stdout.buffer)
    sys.stdout.buffer.flush()


@contextmanager
def naming_written(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Within this, the system's error while `path` is written names it, and nothing temporary.

    That stdout's reader has gone stays an error without a name, as where `print` finds it out.
    """
    try:
        yield
    except OSError as error:
        named = [Path(str(name)) for name in (error.filename, error.filename2) if name is not None]
        is_closed = error.errno == errno.EPIPE and is_stdout(path)
        is_bare = not named and not is_closed and error.errno in WRITE_ERRORS
        if is_bare or (temporary and any(name.is_relative_to(temporary) for name in named)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a folder that becomes `path`, new or empty, at the end; after an error nothing is left."""
    with _in_place_of(path) as (target, temporary):
        temporary.mkdir()
        yield temporary
        if target.exists():
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))
            target.rmdir()  # on Windows no folder takes the place of another


@contextmanager
def library_writing(made: Path, errors: Errors = ()) -> Iterator[None]:
    """Within this, a library writes a file, or files into a folder; OSError at the end unless all are whole.

    Libraries in C++ say nothing, or raise `errors` without a reason, where a disk is full: the system is
    asked for the reason by writing a little more behind each file.
    """
    try:
        yield
    except errors as error:
        _check_whole(made)
        raise OSError(errno.EIO, " ".join(str(error).split()), str(made)) from error
    _check_whole(made)


def _check_whole(made: Path) -> None:
    """Raise the system's error, which names the file, if one can't grow; of a folder all files count."""
    for path in (made, *sorted(made.rglob("*"))):
        if path.is_file():
            size = path.stat().st_size
            with naming_written(path), path.open("ab") as file:
                file.write(bytes(ROOM))
                file.flush()
                file.truncate(size)
                os.fsync(file.fileno())  # file systems that write late say only now what has failed


@contextmanager
def replacing_by_library(path: Path, errors: Errors = ()) -> Iterator[Path]:
    """Yield the name of a file for a library to write, which replaces `path` at the end as by `replacing`."""
    if is_stream(path):
        with temporary_folder() as folder, replacing(path) as stream:
            with library_writing(folder, errors):
                yield folder / "written"
            with (folder / "written").open("rb") as written:
                shutil.copyfileobj(written, stream)
        return
    with (
        _in_place_of(path) as (target, temporary),
        _open_like(target, temporary),
        library_writing(temporary, errors),
    ):
        yield temporary


def write_temporary(path: Path, content: bytes) -> None:
    """Write a file of a temporary folder, of which half is never seen; the system's error names it."""
    with naming_written(path):
        path.write_bytes(content)


def write_atomically(path: Path, content: bytes) -> None:
    """Write `content` to `path`, whole or not at all."""
    with replacing(path) as file:
        file.write(content)


def write_lines(out: Path, lines: Sequence[str]) -> None:
    """Write a text file, UTF-8."""
    write_atomically(out, "".join(f"{line}\n" for line in lines).encode())


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a folder that is removed at the end, or else by the next process that makes one."""
    for left in Path(tempfile.gettempdir()).glob(f"{PREFIX}????????"):
        with suppress(OSError, InputError):  # it is not ours, or in use
            status = left.lstat()
            is_own = stat.S_ISDIR(status.st_mode) and (IS_WINDOWS or status.st_uid == os.getuid())
            if is_own and time.time() - status.st_mtime > YOUNG_S:
                with hold_lock(left):
                    shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=PREFIX) as name, hold_lock(Path(name)):
        yield Path(name)


@contextmanager
def hold_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a path, which ends with the process. InputError if another has it.

    What is locked is a file beside it, as on Windows nobody could read a locked one, nor remove it here.
    """
    target = _target_of(path)
    digest = zlib.crc32(os.fsencode(target.name))
    beside = target.with_name(f"{temporary_prefix(target.name)}{digest:08x}.lock")
    while True:
        with beside.open("ab") as file:
            if not lock_descriptor(file.fileno()):
                raise InputError(f"{path}: another process is writing it; wait for its end")
            if not beside.exists() or not os.path.samestat(os.fstat(file.fileno()), beside.stat()):
                continue  # whoever had the lock before has removed its file
            try:
                yield
            finally:
                if not IS_WINDOWS:
                    beside.unlink(missing_ok=True)
            return


def write_json(out: Path, document: object) -> None:
    """Write a JSON file."""
    write_atomically(out, json_text(document).encode())


def json_text(document: object) -> str:
    """Return a JSON file's content."""
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
