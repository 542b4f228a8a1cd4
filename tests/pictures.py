"""Made-up pictures and files of them, for the tests of panoramas."""

import struct
import zlib
from io import BytesIO

import cv2
import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

XMP_NAMESPACE = "http://ns.google.com/photos/1.0/panorama/"
PNG_HEADER_SIZE = 33  # [byte] magic and IHDR


def smooth_rgb(height=64, width=128):
    """A picture without two like corners, smooth enough for JPEG."""
    v, u = np.mgrid[:height, :width]
    channels = [u * 255 // width, v * 255 // height, (u + v) * 200 // (width + height)]
    return np.stack(channels, axis=2).astype(np.uint8)


def encoded(rgb, suffix, options=()):
    bgr = rgb[:, :, [2, 1, 0, 3][: rgb.shape[2]]] if rgb.ndim == 3 else rgb
    return cv2.imencode(suffix, bgr, list(options))[1].tobytes()


def saved(pixels, kind, mode="RGB", **options):
    file = BytesIO()
    Image.frombytes(mode, pixels.shape[1::-1], pixels.tobytes()).save(file, kind, **options)
    return file.getvalue()


def animation(kind):
    return saved(smooth_rgb(), kind, save_all=True, append_images=[Image.fromarray(255 - smooth_rgb())])


def write(path, content):
    path.write_bytes(content)
    return path


def png_chunk(kind, content):
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def exif(orientation):
    return b"MM\0*\0\0\0\x08" + struct.pack(">HHHIHHI", 1, 0x112, 3, 1, orientation, 0, 0)


def xmp_packet(fields, form="attributes", prefix="GPano"):
    """XMP with Photo Sphere fields, by either of its two forms."""
    names = {name: str(value) for name, value in fields.items()}
    attributes = "".join(f' {prefix}:{k}="{v}"' for k, v in names.items()) if form == "attributes" else ""
    elements = "".join(f"<{prefix}:{k}> {v} </{prefix}:{k}>\n" for k, v in names.items())
    elements = "" if attributes else elements
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" xmlns:{prefix}="{XMP_NAMESPACE}"{attributes}>{elements}'
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    ).encode()


def crop_fields(left, top, width, height, full=(400, 200)):
    return {
        "ProjectionType": "equirectangular",
        "CroppedAreaLeftPixels": left,
        "CroppedAreaTopPixels": top,
        "CroppedAreaImageWidthPixels": width,
        "CroppedAreaImageHeightPixels": height,
        "FullPanoWidthPixels": full[0],
        "FullPanoHeightPixels": full[1],
    }


def with_metadata(content, orientation=None, xmp=None):
    """The JPEG, PNG or WebP with EXIF and XMP added."""
    if content.startswith(b"\xff\xd8"):
        bodies = [b"Exif\0\0" + exif(orientation)] if orientation else []
        bodies += [b"http://ns.adobe.com/xap/1.0/\0" + xmp] if xmp else []
        segments = [b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body for body in bodies]
        return content[:2] + b"".join(segments) + content[2:]
    if content.startswith(b"\x89PNG"):
        chunks = [png_chunk(b"eXIf", exif(orientation))] if orientation else []
        chunks += [png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + xmp)] if xmp else []
        return content[:PNG_HEADER_SIZE] + b"".join(chunks) + content[PNG_HEADER_SIZE:]
    metadata = {b"EXIF": exif(orientation) if orientation else b"", b"XMP ": xmp or b""}
    return with_webp_chunks(content, metadata)


def with_webp_chunks(content, extra):
    """A plain WebP with lossless picture, with further chunks after it."""
    bits = int.from_bytes(content[21:25], "little")
    width, height, has_alpha = bits & 0x3FFF, bits >> 14 & 0x3FFF, content[24] >> 4 & 1
    flags = has_alpha << 4 | 8 * bool(extra.get(b"EXIF")) | 4 * bool(extra.get(b"XMP "))
    head = struct.pack("<B3x", flags) + width.to_bytes(3, "little") + height.to_bytes(3, "little")
    body = b"WEBPVP8X" + struct.pack("<I", 10) + head + content[12:]
    for kind, chunk in extra.items():
        body += (kind + struct.pack("<I", len(chunk)) + chunk + b"\0" * (len(chunk) % 2)) if chunk else b""
    return b"RIFF" + struct.pack("<I", len(body)) + body


def tiff(pixels, tags=None, order="<", next_begin=0):
    """An uncompressed TIFF of (H, W) or (H, W, samples); `tags` {tag: (type, values)} go before its own."""
    samples = 1 if pixels.ndim == 2 else pixels.shape[2]
    strip = pixels.astype(pixels.dtype.newbyteorder(order)).tobytes()
    bits = pixels.dtype.itemsize * 8
    entries = {
        256: (4, [pixels.shape[1]]),
        257: (4, [pixels.shape[0]]),
        258: (3, [bits] * samples),
        259: (3, [1]),
        262: (3, [2 if samples > 2 else 1]),
        273: (4, [8]),
        277: (3, [samples]),
        278: (4, [pixels.shape[0]]),
        279: (4, [len(strip)]),
        **({338: (3, [2])} if samples == 4 else {}),
        **({339: (3, [3])} if pixels.dtype.kind == "f" else {}),
        **(tags or {}),
    }
    letters = {1: "B", 3: "H", 4: "I"}
    begin = 8 + len(strip) + len(strip) % 2
    further = begin + 2 + 12 * len(entries) + 4
    body, tail = b"", b""
    for tag, (kind, values) in sorted(entries.items()):
        packed = struct.pack(order + letters[kind] * len(values), *values)
        if len(packed) > 4:
            place = struct.pack(order + "I", further + len(tail))
            tail += packed + b"\0" * (len(packed) % 2)
            packed = place
        body += struct.pack(order + "HHI", tag, kind, len(values)) + packed.ljust(4, b"\0")
    head = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, begin)
    directory = struct.pack(order + "H", len(entries)) + body + struct.pack(order + "I", next_begin)
    return head + strip + b"\0" * (len(strip) % 2) + directory + tail


# What a viewer does to the stored picture, by EXIF's number.
TURNS = {
    1: lambda image: image,
    2: np.fliplr,
    3: lambda image: np.rot90(image, 2),
    4: np.flipud,
    5: lambda image: np.swapaxes(image, 0, 1),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: np.swapaxes(np.rot90(image, 2), 0, 1),
    8: np.rot90,
}


def write_photo(path, rgb, position=None, accuracy=None, time=None):
    """A JPEG with GPS (latitude, longitude) [deg] and a time of EXIF."""
    exif = Image.Exif()
    if position is not None:
        gps = exif.get_ifd(IFD.GPSInfo)
        tags = (GPS.GPSLatitude, GPS.GPSLatitudeRef, "NS"), (GPS.GPSLongitude, GPS.GPSLongitudeRef, "EW")
        for value, (number, reference, letters) in zip(position, tags, strict=True):
            degrees, rest = divmod(abs(value), 1.0)
            minutes, rest = divmod(rest * 60.0, 1.0)
            gps[number] = (degrees, minutes, rest * 60.0)
            gps[reference] = letters[value < 0]
        if accuracy is not None:
            gps[GPS.GPSHPositioningError] = accuracy
    if time is not None:
        own = exif.get_ifd(IFD.Exif)
        own[Base.DateTimeOriginal], own[Base.SubsecTimeOriginal], own[Base.OffsetTimeOriginal] = time
    Image.fromarray(rgb).save(path, quality=95, exif=exif)
    return path
