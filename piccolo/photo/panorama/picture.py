"""The pixels in a JPEG, PNG, TIFF, WebP, HEIC, AVIF or HDR file, 8 bits a channel, turned as EXIF says.

Sizes are checked before anything is decoded. Each format's class is called directly: Image.open has a limit
that large panoramas exceed, and it can be lifted only for the whole process.
"""

import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, features
from PIL.ExifTags import IFD, Base
from PIL.Image import Transpose
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from ...system.arrays import Bytes, Mask
from ...system.errors import InputError, ResourceError, import_optional
from ...system.files.json_file import read_bytes
from ...system.jobs.memory import check_memory
from . import radiance
from .radiance import RadianceFile

WANTED = "wanted a whole JPEG, PNG, TIFF, WebP, HEIC, AVIF or Radiance HDR picture"
MIN_PICTURE_WIDTH = 128
MIN_PICTURE_HEIGHT = 64
MAX_PICTURE_WIDTH = 32768
MAX_PICTURE_HEIGHT = 16384
# of memory while a picture is decoded, turned and masked; 10 were measured, more with alpha
PICTURE_BYTES_PER_PIXEL = 12
SPHERE_NAMESPACE = b"http://ns.google.com/photos/1.0/panorama/"
MAX_XMP_SIZE = 1 << 20  # [byte] longer packets are ignored
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
FORMATS: dict[bytes, type[ImageFile]] = {
    PNG_MAGIC: PngImageFile,
    b"\xff\xd8": JpegImageFile,
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), TiffImageFile),
    b"RIFF": WebPImageFile,
    radiance.MAGIC: RadianceFile,
}
# of still pictures, after the size of a box and "ftyp"
HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"mif1")
# the best compression: a bit for a block of 8 x 8; by zlib 1040 bytes of 8 pixels; by LZW 3840; a plain image
# packs to nothing in WebP; 127 pixels in four runs
MAX_PIXELS_PER_BYTE = {"JPEG": 512, "PNG": 8 * 1040, "TIFF": 8 * 3840}
MAX_PIXELS_PER_BYTE |= dict.fromkeys(("WEBP", "HEIF", "AVIF"), 1 << 30) | {"HDR": 16}
# how a viewer turns the stored picture, by EXIF's orientation
TURNS: dict[object, Transpose] = {
    2: Transpose.FLIP_LEFT_RIGHT,
    3: Transpose.ROTATE_180,
    4: Transpose.FLIP_TOP_BOTTOM,
    5: Transpose.TRANSPOSE,
    6: Transpose.ROTATE_270,
    7: Transpose.TRANSVERSE,
    8: Transpose.ROTATE_90,
}
PHOTOMETRIC = 262  # tags of TIFF
SAMPLE_FORMAT = 339
DNG_VERSION = 50706
SUBFILE_TYPE = 254
REDUCED = 1
WHITE_IS_ZERO = 0
UNSIGNED = 1
END_MARK = b"\xff\xd9"  # of a JPEG
# run in a process of its own: libtiff reports damage on stderr, which belongs to the whole process
DECODE_TIFF = """\
import io, sys
from PIL import Image, TiffImagePlugin
Image.MAX_IMAGE_PIXELS = None
image = TiffImagePlugin.TiffImageFile(io.BytesIO(sys.stdin.buffer.read()))
image.load()
sys.stdout.buffer.write(image.convert(sys.argv[1]).tobytes())
"""

# Pillow's warnings on odd files. Filters are the process's, so they are set once, here, and not by threads.
warnings.filterwarnings("ignore", module=r"PIL\.")


@dataclass(frozen=True)
class Picture:
    """The pixels of a file, of any shape."""

    rgb: Bytes  # (H, W, 3)
    is_valid: Mask  # (H, W), False where alpha is 0
    xmp: bytes = b""  # packet, or empty
    warnings: tuple[str, ...] = ()
    exif: Mapping[int, object] = field(default_factory=dict)  # camera and exposure, by tag; empty if damaged
    orientation: object = None  # EXIF's number, by which the stored picture was turned to become this one

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.rgb.shape[1], self.rgb.shape[0]


def read_picture(path: Path, min_size: tuple[int, int] = (MIN_PICTURE_WIDTH, MIN_PICTURE_HEIGHT)) -> Picture:
    """Return the picture in a file. Grey becomes RGB; of 16 bits the upper 8 are kept (v >> 8).

    Raise InputError if the file is missing or damaged, has an unknown format, or its size is out of range.
    """
    data = read_bytes(path, WANTED)
    with open_picture(path, data) as image:
        _check(path, image, len(data), min_size)
        mode = "RGBA" if image.has_transparency_data else "RGB"
        is_16_bit_grey = image.mode.startswith("I;16")
        pixels = np.array(_decode(path, data, image, image.mode if is_16_bit_grey else mode))
        if is_16_bit_grey:
            is_valid = pixels != image.info.get("transparency", -1)
            pixels = cv2.cvtColor((pixels >> 8).astype(np.uint8), cv2.COLOR_GRAY2RGB)
        elif pixels.shape[2] == 4:
            is_valid = pixels[..., 3] > 0
            pixels = np.ascontiguousarray(pixels[..., :3])
        else:
            is_valid = np.ones(pixels.shape[:2], dtype=np.bool_)
        return Picture(
            np.asarray(pixels, np.uint8),
            is_valid,
            xmp=_xmp(image),
            warnings=_warnings(image),
            exif=read_exif(image),
            orientation=_orientation(image),
        )


def picture_shape(path: Path) -> tuple[tuple[int, int], object]:
    """Return (width, height) [px] and EXIF's orientation, or None, of the picture in a file, not decoded."""
    with open_picture(path, read_bytes(path, WANTED)) as image:
        return image.size, _orientation(image)


@contextmanager
def open_picture(path: Path, data: bytes) -> Iterator[ImageFile]:
    """Yield the picture in `data`, opened but not decoded; errors of Pillow become an InputError."""
    if not data:
        raise InputError(f"{path}: the file is empty, {WANTED}")
    kind = next((kind for magic, kind in FORMATS.items() if data.startswith(magic)), None)
    if data[4:8] == b"ftyp" and data[8:12] in HEIF_BRANDS:
        kind = import_optional(path, "pillow_heif").HeifImageFile
    if data[4:12] == b"ftypavif" and features.check("avif"):  # Pillow 11.3 and newer
        kind = import_optional(path, "PIL.AvifImagePlugin").AvifImageFile
    if kind is None:
        raise InputError(f"{path}: begins with {data[:8]!r}, {WANTED}")
    try:
        yield kind(BytesIO(data))
    except (InputError, MemoryError):
        raise
    except Exception as error:  # Pillow's readers raise errors of many kinds
        words = " ".join(str(error).split())
        why = f"the {kind.format} is cut off, damaged or of an unsupported kind ({words})"
        raise InputError(f"{path}: {why}, {WANTED}") from error


def _check(path: Path, image: ImageFile, num_bytes: int, min_size: tuple[int, int]) -> None:
    """Refuse kinds that would be read wrongly, and sizes out of range, before memory is allocated."""
    longer = max(image.size)
    shorter = min(image.size)
    found = f"{path}: found {image.width} x {image.height}"
    if longer < min_size[0] or shorter < min_size[1]:
        raise InputError(f"{found}, wanted at least {min_size[0]} x {min_size[1]}")
    if longer > MAX_PICTURE_WIDTH or shorter > MAX_PICTURE_HEIGHT:
        raise InputError(f"{found}, wanted at most {MAX_PICTURE_WIDTH} x {MAX_PICTURE_HEIGHT}")
    if longer * shorter > num_bytes * MAX_PIXELS_PER_BYTE[str(image.format)]:
        raise InputError(f"{found} in a file too small for it, {WANTED}")
    check_memory(longer * shorter * PICTURE_BYTES_PER_PIXEL, f"{found}, which", "make the picture smaller")
    if image.format in ("PNG", "WEBP") and getattr(image, "is_animated", False):
        raise InputError(f"{path}: the {image.format} is animated, wanted a still picture")
    tags = image.tag_v2 if isinstance(image, TiffImageFile) else {}
    if DNG_VERSION in tags or tags.get(SUBFILE_TYPE) == REDUCED:
        raise InputError(f"{path}: a raw file, or a thumbnail, wanted the developed picture (JPEG, TIFF)")
    is_inverted = image.mode.startswith("I;16") and tags.get(PHOTOMETRIC) == WHITE_IS_ZERO
    if image.mode in ("I", "F") or is_inverted or set(tags.get(SAMPLE_FORMAT, ())) - {UNSIGNED}:
        wanted = "wanted unsigned ones of 8 or 16 bits"
        raise InputError(f"{path}: the {image.format}'s numbers are signed, inverted or of 32 bits, {wanted}")


def _decode(path: Path, data: bytes, image: ImageFile, mode: str) -> Image.Image:
    """Return the picture decoded, turned as EXIF says, and converted to Pillow's `mode`."""
    if isinstance(image, TiffImageFile):  # Pillow turns a TIFF while it decodes it
        if image.use_load_libtiff:
            return _decode_apart(path, data, mode, image.size)
        image.im = Image.new(image.mode, image._tile_size).im  # else Pillow makes it, with a limit of its own
    if isinstance(image, PngImageFile):
        PngImageFile(BytesIO(data)).verify()  # the checksums, which decoding ignores
    if isinstance(image, JpegImageFile) and _is_cut(data, image):
        raise InputError(f"{path}: the JPEG ends before its picture does (cut off?), {WANTED}")
    image.load()  # here, as NumPy would ignore its errors
    converted = image if image.mode == mode else image.convert(mode)
    turn = TURNS.get(_orientation(image))
    return converted if turn is None else converted.transpose(turn)


def _orientation(image: ImageFile) -> object:
    """Return EXIF's orientation number; None if EXIF has none or is damaged.

    ImageOps.exif_transpose is not used: it also rewrites EXIF, and raises where EXIF is odd.
    """
    try:
        return image.getexif().get(Base.Orientation)
    except Exception:  # Pillow raises errors of many kinds for damaged metadata
        return None


def read_exif(image: ImageFile) -> dict[int, object]:
    """Return EXIF's fields of camera and exposure, by tag; empty if EXIF is missing or damaged."""
    try:
        return dict(image.getexif().get_ifd(IFD.Exif))
    except Exception:  # Pillow raises errors of many kinds for damaged metadata
        return {}


def _decode_apart(path: Path, data: bytes, mode: str, size: tuple[int, int]) -> Image.Image:
    """Decode the compressed TIFF in `data` in a process of its own."""
    command = [sys.executable, "-P", "-c", DECODE_TIFF, mode]
    done = subprocess.run(command, input=data, capture_output=True, check=False)
    if done.returncode < 0:
        raise ResourceError(f"{path}: the process that decodes the TIFF was killed; it may need more memory")
    if done.returncode:
        text = (done.stderr.decode(errors="replace").splitlines() or ["nothing said"])[-1]
        if text.startswith("MemoryError"):
            raise ResourceError(f"{path}: the process that decodes the TIFF has too little memory")
        raise OSError(text)
    return Image.frombytes(mode, size, done.stdout)


def _is_cut(data: bytes, image: JpegImageFile) -> bool:
    """Return True if a JPEG that was just opened has no end mark, or has it before the picture ends.

    libjpeg fills missing parts with grey. If bytes are added before the mark, these parts change.
    """
    end = data.find(END_MARK, image.fp.tell() if image.fp else 0)
    width, height = image.size
    corner = image.crop((width - 8, height - 8, width, height)).convert("RGB")
    if end < 0 or corner.getcolors(1) != [(64, (128, 128, 128))]:
        return end < 0
    longer = JpegImageFile(BytesIO(data[:end] + b"\x5a" * 64 + data[end:]))
    return longer.tobytes() != image.tobytes()


def _xmp(image: ImageFile) -> bytes:
    """Return the picture's XMP packet; empty if it has none, or one that is damaged or too long.

    If a JPEG has several, it is the one with fields of a Photo Sphere.
    """
    packets = [content for name, content in getattr(image, "applist", []) if name == "APP1"]
    xmp = next((packet for packet in packets if SPHERE_NAMESPACE in packet), image.info.get("xmp", b""))
    return xmp if isinstance(xmp, bytes) and len(xmp) <= MAX_XMP_SIZE else b""


def _warnings(image: ImageFile) -> tuple[str, ...]:
    if image.format == "HDR":
        return (radiance.EXPOSED,)
    is_several = image.format == "TIFF" and getattr(image, "is_animated", False)
    return ("found more than one picture in the TIFF, the first was read",) if is_several else ()


def encode_image(image: Bytes | NDArray[np.uint16], suffix: str, quality: int = 95) -> bytes:
    """Return the content of an image file, for an image (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) grey.

    The suffix, such as ".png", names the format; `quality`, up to 100, is for JPEG. Raise OSError if the
    image can't be encoded.
    """
    order = cv2.COLOR_RGBA2BGRA if image.ndim == 3 and image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    bgr = cv2.cvtColor(image, order) if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix in (".jpg", ".jpeg") else []
    is_encoded, content = cv2.imencode(suffix, bgr, options)
    if not is_encoded:
        raise OSError(f"an image of {image.shape[1]} x {image.shape[0]} could not be encoded as {suffix}")
    return content.tobytes()
