"""Videos: frames written as picture files, the sharpest around each time step."""

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...system.arrays import Bytes
from ...system.errors import InputError, import_optional
from ...system.files.atomic import write_temporary
from ...system.jobs.memory import check_memory

SHARPNESS_WIDTH = 512  # [px] at which sharpness is measured
NEIGHBORHOOD = 0.25  # of a step, before and after its time, in which the sharpest frame is chosen
DISTINCT_SIZE = 32, 18  # [px] at which the change between frames is measured
FRAME_QUALITY = 95  # of the JPEG files
FRAME_BYTES_PER_PIXEL = 20  # of memory for frames in several stages of decoding; 19 were measured
WANTED = "wanted a video that PyAV reads, such as MP4"


class VideoFrame(NamedTuple):
    """A frame of a video, written as a picture."""

    time: float  # [s] from the beginning of the video
    path: Path  # of the picture file


def frames_of(video: Path, every: float, folder: Path) -> Iterator[VideoFrame]:
    """Write and yield the sharpest frame around each step of `every` [s]. InputError if it is no video."""
    best: tuple[float, float, Bytes] | None = None  # sharpness, time, RGB
    slot = 0
    for time, frame in _decode(video):
        while time > (slot + NEIGHBORHOOD) * every:
            if best is not None:
                yield _write_frame(video, folder, best[1], best[2])
            best = None
            slot += 1
        if time >= (slot - NEIGHBORHOOD) * every:
            rgb = _upright(frame)
            sharpness = measure_sharpness(rgb)
            if best is None or sharpness > best[0]:
                best = sharpness, time, rgb
    if best is not None:
        yield _write_frame(video, folder, best[1], best[2])


def frames_of_chapters(
    videos: Sequence[Path], every: float, folder: Path
) -> Iterator[tuple[Path, VideoFrame, float]]:
    """Yield each frame's video, the frame, and its time [s] from the beginning of the first video."""
    if twice := [video for video in videos if videos.count(video) > 1]:
        raise InputError(f"{twice[0]}: found it twice, wanted each chapter once")
    begin = 0.0
    for number, video in enumerate(videos):
        own = folder / str(number)  # chapters in different folders may have the same name
        own.mkdir()
        for frame in frames_of(video, every, own):
            yield video, frame, begin + frame.time
        begin += _measure_length(video)


def frames_at(video: Path, times: Collection[float], folder: Path) -> Iterator[VideoFrame]:
    """Write the frames at times [s], which are compared in milliseconds, into a folder, and yield them."""
    left = {round(1000.0 * time) for time in times}
    for time, frame in _decode(video) if left else ():
        if round(1000.0 * time) in left:
            left.remove(round(1000.0 * time))
            yield _write_frame(video, folder, time, _upright(frame))
        if not left:
            return


def choose_distinct(frames: Sequence[Path], most: int) -> list[int]:
    """Return the indices of at most `most` frames between which the picture changes about equally.

    The first and the last are among them. While the camera stands still, few are chosen.
    """
    if len(frames) <= most:
        return list(range(len(frames)))
    grays = (np.asarray(cv2.imread(str(frame), cv2.IMREAD_REDUCED_GRAYSCALE_8)) for frame in frames)
    small = [cv2.resize(gray, DISTINCT_SIZE, interpolation=cv2.INTER_AREA).astype(float) for gray in grays]
    along = np.cumsum([0.0, *(np.abs(after - before).mean() for before, after in pairwise(small))])
    return sorted({int(np.abs(along - at).argmin()) for at in np.linspace(0.0, along[-1], most)})


def measure_sharpness(rgb: Bytes) -> float:
    """Return the variance of the Laplacian of an image (H, W, 3), made small (Pech-Pacheco et al., 2000)."""
    height = max(round(rgb.shape[0] * SHARPNESS_WIDTH / rgb.shape[1]), 1)
    small = cv2.resize(rgb, (SHARPNESS_WIDTH, height), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())


def _upright(frame: Any) -> Bytes:
    """Return the RGB (H, W, 3) of a frame, turned as players show it; phones store it unturned."""
    rgb = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
    return np.ascontiguousarray(np.rot90(rgb, round(frame.rotation / 90)))


def _decode(video: Path) -> Iterator[tuple[float, Any]]:
    """Yield the frames as PyAV returns them, each after its time [s] from the first frame."""
    av = import_optional(video, "av", "video")
    begin: float | None = None
    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise InputError(f"{video}: found no picture in it, {WANTED}")
            stream = container.streams.video[0]
            sizes = [(some.width, some.height) for some in container.streams.video]
            if sizes.count(sizes[0]) > 1:
                found = f"found {len(sizes)} videos of {stream.width} x {stream.height}, of one lens each"
                raise InputError(f"{video}: {found}, wanted one that the camera's program has stitched")
            label = f"{video}: frames of {stream.width} x {stream.height}"
            check_memory(
                stream.width * stream.height * FRAME_BYTES_PER_PIXEL, label, "make the video smaller"
            )
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                if frame.time is None:
                    raise InputError(f"{video}: found a frame without a time, {WANTED}")
                begin = frame.time if begin is None else begin
                yield float(frame.time - begin), frame
    except av.FFmpegError as error:
        if isinstance(error, OSError) and not video.exists():
            raise InputError(f"{video}: no such file, {WANTED}") from error
        raise InputError(f"{video}: found {error.strerror}, {WANTED}") from error


def _measure_length(video: Path) -> float:
    """Return the length [s] of a video that can be read."""
    av = import_optional(video, "av", "video")
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        if stream.duration is not None:
            return float(stream.duration * stream.time_base)
        if container.duration is not None:
            return float(container.duration / av.time_base)
    raise InputError(f"{video}: found no length in it, {WANTED}")


def _write_frame(video: Path, folder: Path, time: float, rgb: Bytes) -> VideoFrame:
    path = folder / f"{video.stem}_{round(1000.0 * time):08d}.jpg"
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    write_temporary(path, cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, FRAME_QUALITY])[1].tobytes())
    return VideoFrame(time, path)
