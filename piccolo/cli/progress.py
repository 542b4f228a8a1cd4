"""How the tools show on stderr how far they are, by bars that vanish when full, and warn."""

import sys
from collections.abc import Callable, Iterator
from typing import Any

from tqdm import tqdm

from ..runtime.threads import Show

DELAY = 0.5  # seconds: what takes less needs no bar


def shown(is_quiet: bool) -> Show:
    """What wraps values in a bar, or in nothing."""

    def show(values: Iterator[Any], total: int | None, label: str) -> Iterator[Any]:
        return iter(tqdm(values, label, total, leave=False, disable=is_quiet, file=sys.stderr, delay=DELAY))

    return show


def warned(is_quiet: bool) -> Callable[[str], None]:
    """What writes a warning, once however often it comes, or nothing."""
    said: set[str] = set()

    def warn(warning: str) -> None:
        if not is_quiet and warning not in said:
            said.add(warning)
            tqdm.write(f"warning: {warning}", file=sys.stderr)

    return warn
