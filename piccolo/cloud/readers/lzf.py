"""LZF, the compression inside PCD files: runs of bytes as they are, and copies of what came before."""

from ...runtime.jit import inline_kernel, kernel

BROKEN = -1
MAX_RATIO = 88  # three bytes can stand for a copy of 264
MAX_LITERALS = 32  # a control byte below it is a run of one more bytes than it says
LONG_COPY = 7  # the length in the control byte's upper three bits that has a byte of its own behind it


@inline_kernel
def append(source, begin, length, out, filled):
    """The bytes of `out` filled, after `length` bytes of `source` follow the first `filled`, or BROKEN."""
    if begin < 0 or begin + length > len(source) or filled + length > len(out):
        return BROKEN
    for k in range(length):  # one by one: a copy that reaches into itself repeats a pattern
        out[filled + k] = source[begin + k]
    return filled + length


@kernel
def decompress_lzf(data, out):
    """Fill `out` (uint8) from compressed `data` (uint8); the number of bytes filled, or BROKEN.

    Broken is what would read before the beginning of `out`, or go beyond the end of either.
    """
    i, filled = 0, 0
    while filled >= 0 and i < len(data):
        control = int(data[i])
        i += 1
        if control < MAX_LITERALS:
            filled = append(data, i, control + 1, out, filled)
            i += control + 1
        else:
            length = control >> 5
            is_long = length == LONG_COPY
            if i + is_long >= len(data):
                return BROKEN
            if is_long:
                length += int(data[i])
                i += 1
            distance = ((control & 31) << 8) + int(data[i]) + 1
            filled = append(out, filled - distance, length + 2, out, filled)
            i += 1
    return filled
