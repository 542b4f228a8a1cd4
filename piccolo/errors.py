"""The one exception that bad input raises."""

from pathlib import Path


class InputError(ValueError):
    """Bad input: one line that names the file or option, says what is wrong and what to do."""


def unreadable(path: Path, error: OSError) -> InputError:
    """The InputError for a file that the system refuses to read."""
    return InputError(f"{path}: cannot be read ({error.strerror or error})")
