"""Photos that are frames of a video, as results of localize.py --video name them: taken out for a report."""

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputError
from ..files.temporary import temporary_folder
from ..panorama.video import frames_at

FRAME = re.compile(r"(?P<video>.+)#t=(?P<time>\d+\.\d{3})", re.DOTALL)


@contextmanager
def taken_out(photos: Sequence[Path]) -> Iterator[dict[Path, Path]]:
    """Files of those photos that are frames of a video, until the end; of others none.

    A video that can't be read has none either: its frames are then photos that are not there.
    """
    by_video: dict[Path, dict[int, Path]] = defaultdict(dict)
    for photo in photos:
        if found := FRAME.fullmatch(str(photo)):
            by_video[Path(found["video"])][round(1000.0 * float(found["time"]))] = photo
    with temporary_folder() as folder:
        files: dict[Path, Path] = {}
        for number, (video, frames) in enumerate(by_video.items()):
            own = folder / str(number)
            own.mkdir()
            try:
                for frame in frames_at(video, [time / 1000.0 for time in frames], own):
                    files[frames[round(1000.0 * frame.time)]] = frame.path
            except (OSError, InputError):
                continue
        yield files
