"""How the tools show how far they are: bars on stderr that vanish when they are full."""

import sys
from collections.abc import Iterator
from typing import Any

from tqdm import tqdm

from piccolo.threads import Show

DELAY = 0.5  # seconds: what takes less needs no bar


def shown(is_quiet: bool) -> Show:
    """What wraps values in a bar, or in nothing."""

    def show(values: Iterator[Any], total: int | None, label: str) -> Iterator[Any]:
        return iter(tqdm(values, label, total, leave=False, disable=is_quiet, file=sys.stderr, delay=DELAY))

    return show
