"""What tests of damaged files share."""

import errno
import os
import resource
from contextlib import contextmanager

import pytest

from piccolo.photo.photo import Photo
from piccolo.system.errors import InputError


def assert_input_error(message, call, *arguments, **options):
    """A call is refused in one line that holds an expression."""
    with pytest.raises(InputError, match=message) as error:
        call(*arguments, **options)
    assert "\n" not in str(error.value)


def fill_disk(*_):
    """Refuse to write, as on a full device."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextmanager
def small_files(limit):
    """Within this no file grows beyond `limit` bytes, as on a full disk; Python has SIGXFSZ ignored."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def assert_refused(message, read, path, *arguments, **options):
    """`read` refuses a file or photo in one line that begins with its name and holds an expression."""
    with pytest.raises(InputError, match=message) as error:
        read(path, *arguments, **options)
    text = str(error.value)
    del error  # its traceback would keep files open until the garbage collector comes
    name = path.name if isinstance(path, Photo) else str(path)
    assert len(text) < 500 + len(name)
    assert text.startswith(name)
    assert "\n" not in text


def read_or_refused(read, path):
    """What `read` makes of a file, or the one line, naming the file, with which it refuses."""
    try:
        return read(path), ""
    except InputError as error:
        message = str(error)
    if str(path) not in message or "\n" in message:
        raise AssertionError(f"no line that names {path}: {message}")
    return None, message


def mutated(draw, integers, content, num_flips=4):
    """`content` with some bytes drawn anew and, in half of the draws, cut off; draws by hypothesis."""
    changed = bytearray(content)
    for _ in range(draw(integers(0, num_flips))):
        changed[draw(integers(0, len(changed) - 1))] = draw(integers(0, 255))
    return bytes(changed[: draw(integers(0, len(changed)))] if draw(integers(0, 1)) else changed)
