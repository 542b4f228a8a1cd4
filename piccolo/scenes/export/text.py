"""Numbers as text, the same to the last bit when read back, and text files with what belongs beside them."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from ...runtime.atomic import write_atomically
from .model import Options


def numbers(values: Iterable[float], separator: str = " ") -> str:
    """The shortest text of each number that reads back as the same float64."""
    return separator.join(repr(float(value)) for value in values)


def offset_comment(options: Options) -> list[str]:
    """A comment line that gives the offset; none without."""
    if options.offset is None:
        return []
    return [f"# world position = position here + {numbers(options.offset)}"]


def write_lines(out: Path, lines: Sequence[str]) -> None:
    """A text file, UTF-8."""
    write_atomically(out, "".join(f"{line}\n" for line in lines).encode())


def write_offset_beside(out: Path, options: Options) -> None:
    """Where a format has no place for the offset: <name>.offset.txt, three numbers."""
    if options.offset is not None:
        write_lines(
            out.with_name(f"{out.name}.offset.txt"), [*offset_comment(options), numbers(options.offset)]
        )
