"""Frames as an MP4 video."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

from ..arrays import Bytes
from ..files.atomic import replacing
from ..optional import import_optional


@contextmanager
def writing_video(path: Path, rate: float, size: tuple[int, int]) -> Iterator[Callable[[Bytes], None]]:
    """Yield a function that takes the frames (H, W, 3) of an MP4 video (H.264), `rate` a second.

    `size` (W, H) is even both ways. Raises InputError if PyAV is not there.
    """
    av = import_optional("video", "av", "video")
    with replacing(path) as file, av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", Fraction(rate).limit_denominator(1001))
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "18"}  # nothing to be seen is lost

        def add(rgb: Bytes) -> None:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))

        yield add
        container.mux(stream.encode())
