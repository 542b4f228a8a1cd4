"""What a picture's bytes say of it, before anything is decoded."""

from dataclasses import dataclass

WANTED = "wanted a whole JPEG, PNG, TIFF or WebP panorama"
MAX_XMP_SIZE = 1 << 20  # [byte] what is longer is left aside


@dataclass(frozen=True)
class Header:
    """The picture's size as stored, and what the decoder has to know."""

    width: int
    height: int
    max_num_pixels: int  # that so many bytes can hold
    orientation: int = 1  # by EXIF's numbers: how the decoded picture is yet to be turned
    has_alpha: bool = False
    is_deep: bool = False  # decode all 16 bits: OpenCV rounds those of TIFF in its own way
    xmp: bytes = b""
    patches: tuple[tuple[int, bytes], ...] = ()  # places, and bytes to put there before decoding
    warnings: tuple[str, ...] = ()
