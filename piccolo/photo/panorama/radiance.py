"""Radiance HDR pictures (RGBE), whose pixels are linear light, opened as Pillow's formats are, in 8 bits."""

import re
from typing import Any

import cv2
import numpy as np
from PIL import Image
from PIL.ImageFile import ImageFile

from ...geometry.colors import to_bytes

MAGIC = b"#?R"  # of files that begin with #?RADIANCE or #?RGBE
RADIANCE_HEAD_SIZE = 1 << 12  # [byte] in which the size is searched
SIZE_LINE = re.compile(rb"\n-Y (\d{1,6}) \+X (\d{1,6})\n")  # upright, as all programs write it
MIDDLE_GREY = 0.18  # the mean light becomes this fraction of white
EXPOSED = "HDR, exposed so that the geometric mean of its light is a middle grey; more than white is cut"


class RadianceFile(ImageFile):
    """A Radiance picture, decoded by OpenCV and converted: one exposure for all pixels, then sRGB."""

    format = "HDR"

    def _open(self) -> None:
        size = SIZE_LINE.search(self.fp.read(RADIANCE_HEAD_SIZE)) if self.fp else None
        if size is None:
            raise SyntaxError("no line '-Y height +X width'")
        self._mode = "RGB"
        self._size = int(size[2]), int(size[1])

    def load(self) -> Any:
        """Decode the picture, unless that was done before."""
        if self._im is None and self.fp:
            self.fp.seek(0)
            data = np.frombuffer(self.fp.read(), np.uint8)
            bgr = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
            if bgr is None:
                raise SyntaxError("its data are cut off or broken")
            light = bgr[..., ::-1].astype(np.float64)
            brightness = light.mean(axis=2)
            is_lit = brightness > 0.0
            mean = np.exp(np.log(brightness[is_lit]).mean()) if is_lit.any() else 1.0
            self.im = Image.fromarray(to_bytes(light * (MIDDLE_GREY / mean))).im
        return Image.Image.load(self)
