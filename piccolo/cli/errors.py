"""How the tools end: what an error says on stderr, and the exit code that a shell script sees."""

import os
import sys
import traceback
from collections.abc import Callable

from tqdm import tqdm

from ..errors import InputError

EXIT_BAD_USAGE, EXIT_BAD_INPUT, EXIT_INTERNAL, EXIT_INTERRUPTED, EXIT_BROKEN_PIPE = 2, 3, 4, 130, 141


def complain(program: str, is_debug: bool, text: str, exit_code: int) -> int:
    """One line on stderr, the traceback of the error at hand if `is_debug`; returns the exit code."""
    if is_debug:
        traceback.print_exc()
    tqdm.write(f"{program}: {text}", file=sys.stderr)
    return exit_code


def words_of(error: OSError | InputError) -> str:
    """What an error says: of the system's, the file and what went wrong."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: cannot be used ({error.strerror})"
    return str(error)


def nothing_to_check() -> None:
    """No option that could be wrong by itself."""


def guarded(
    program: str, is_debug: bool, action: Callable[[], int], check: Callable[[], object] = nothing_to_check
) -> int:
    """The exit code of a tool's work, or of the error that ended it.

    `check` comes first, and says by InputError that the options are wrong, whatever the files hold.
    """
    try:
        check()
    except InputError as error:
        return complain(program, is_debug, str(error), EXIT_BAD_USAGE)
    try:
        code = action()
        sys.stdout.flush()  # here, where a closed pipe is caught
        return code
    except BrokenPipeError:  # the reader of stdout has gone: say nothing, not even at the flush at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    except KeyboardInterrupt:
        return complain(program, is_debug, "interrupted", EXIT_INTERRUPTED)
    except (OSError, InputError) as error:
        return complain(program, is_debug, words_of(error), EXIT_BAD_INPUT)
    except Exception as error:  # the last line of defence: a code and one line for the shell
        text = f"internal error: {error!r}; --debug shows where"
        return complain(program, is_debug, text, EXIT_INTERNAL)
