"""The exceptions of bad input, a missing library and a system that gave way, in words for a person."""

import errno
import re
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import FrameType, ModuleType

# of the system's errors those of the path itself, which come again however often it is tried
LASTING = {
    *(errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM),
    *(errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL, errno.ENXIO, errno.ENODEV),
}
# control characters, line ends, halves of characters
UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


class InputError(ValueError):
    """Bad input: one line that names the file or option, says what is wrong and what to do."""


class ResourceError(InputError):
    """Memory, a disk or a network gave way: the same input may do when it is tried again."""


def unreadable(path: Path, error: OSError | ValueError) -> InputError:
    """Return the error for a file that the system refuses to read; a ValueError is of its name."""
    kind = ResourceError if isinstance(error, OSError) and is_passing(error) else InputError
    return kind(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})")


def is_passing(error: Exception) -> bool:
    """Return True for an error that may not come again when the same is tried again."""
    if isinstance(error, OSError):
        return error.errno not in LASTING
    return isinstance(error, ResourceError) or not isinstance(error, InputError)


def text_of(error: OSError | InputError) -> str:
    """Return an error in one line: of the system's, the file and what went wrong."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: cannot be used ({error.strerror})"
    if isinstance(error, OSError) and error.strerror:  # of a stream or pipe, which have no name
        return f"writing or reading failed ({error.strerror})"
    return str(error)


def printable(text: str) -> str:
    """Return a text on one line: control characters and bytes of names that are no text are escaped."""
    return UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def import_optional(what: Path | str, module_name: str, extra: str = "formats") -> ModuleType:
    """Return the module that `what` needs, or a ResourceError that says how to install it."""
    try:
        with holding_signals():
            return import_module(module_name)
    except MemoryError:
        raise
    except Exception as error:  # libraries raise what they like of a part that can't be loaded
        found = " ".join(str(error).split())
        raise ResourceError(
            f"{what}: needs {module_name}, which can't be imported ({found}); "
            f"pip install 'piccolo-localize[{extra}]', in a checkout '.[{extra}]'"
        ) from error


@contextmanager
def holding_signals() -> Iterator[None]:
    """Within this, in the main thread, SIGINT and SIGTERM wait: they come at its end.

    A library that is interrupted while it is imported makes another error of it, or goes on without a part.
    """
    if threading.current_thread() is not threading.main_thread():  # where no handler is called
        yield
        return
    came: list[int] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {number: handler for number, handler in handlers.items() if handler is not None}  # not of C's

    def keep(number: int, _frame: FrameType | None) -> None:
        came.append(number)

    for number in before:
        signal.signal(number, keep)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
