"""The cone around what a photo shows; the first descents use only the cells of a view inside it."""

import math

import numpy as np
from numpy.typing import NDArray

from ..geometry.cone import Cone, cone_around
from ..geometry.sphere import pixel_rays
from ..geometry.vectors import rotate
from ..photo.panorama.texels import Texels, find_valid
from ..system.arrays import Array, Int64s
from ..system.kernels.jit import inline_kernel

CONE_MARGIN = math.radians(20.0)  # [rad] a camera turns by less than this in a descent


def find_cone(image: Texels, margin: float = CONE_MARGIN) -> Cone:
    """Return the cone in the camera's frame around an image's valid pixels, widened by `margin` [rad]."""
    return cone_around(pixel_rays(image.width)[find_valid(image)]).widen(margin)


@inline_kernel
def select_cells(
    offsets: NDArray[np.int16],
    unit: np.float32,
    cone: Cone,
    R_cam_from_map: Array,
    center: Array,
    kept: Int64s,
) -> int:
    """Write the indices of the cells that lie in a camera's cone into `kept`; return their number.

    `offsets` (3, N) times `unit` [m] are the cells' positions; `center` (3,) [m] is the camera's, in the same
    frame. The cone is in the camera's axes.
    """
    axis = rotate(R_cam_from_map.T, (cone.x, cone.y, cone.z))
    num = 0
    for j in range(offsets.shape[1]):
        x = np.float32(offsets[0, j]) * unit - center[0]
        y = np.float32(offsets[1, j]) * unit - center[1]
        z = np.float32(offsets[2, j]) * unit - center[2]
        along = axis[0] * x + axis[1] * y + axis[2] * z
        if along >= cone.cos_angle * math.sqrt(x * x + y * y + z * z):
            kept[num] = j
            num += 1
    return num
