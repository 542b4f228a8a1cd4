"""LZF, as binary_compressed PCD files have it."""

import naive
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from piccolo.cloud.readers.pcd import LZF_BROKEN, MAX_RATIO, decompress_lzf


def compress(data):
    """LZF data: the last place of each three bytes is remembered, and copied from as far as it goes."""
    out, places, literals, i = bytearray(), {}, bytearray(), 0

    def flush():
        for k in range(0, len(literals), 32):
            out.append(len(literals[k : k + 32]) - 1)
            out.extend(literals[k : k + 32])
        literals.clear()

    while i < len(data):
        at, key = places.get(data[i : i + 3], -9000), data[i : i + 3]
        places[key] = i
        length = 0
        if i - at <= 8192 and len(key) == 3:
            while length < 264 and i + length < len(data) and data[at + length] == data[i + length]:
                length += 1
        if length < 3:
            literals.append(data[i])
            i += 1
            continue
        flush()
        high, low = divmod(i - at - 1, 256)
        out.extend([(length - 2) * 32 + high, low] if length < 9 else [224 + high, length - 9, low])
        i += length
    flush()
    return bytes(out)


def unpacked(data, size):
    out = np.full(size, 77, dtype=np.uint8)
    filled = decompress_lzf(np.frombuffer(data, np.uint8), out)
    return None if filled == LZF_BROKEN else out[:filled].tobytes()


@settings(deadline=None, max_examples=60)
@given(
    words=st.lists(st.binary(min_size=1, max_size=12), min_size=1, max_size=4),
    picks=st.lists(st.integers(0, 3), max_size=400),
)
def test_lzf_brings_back_what_was_compressed(words, picks):
    data = b"".join(words[pick % len(words)] for pick in picks)
    packed = compress(data)
    assert naive.decompress_lzf(packed) == data
    assert unpacked(packed, len(data)) == data
    assert unpacked(packed, len(data) - 1) is None if data else True


def test_lzf_copies_far_and_long():
    noise = np.random.default_rng(1).bytes(8192)
    for data in (noise + noise, bytes(100_000), noise[:4000] + bytes(3000) + noise[:4000]):
        assert unpacked(compress(data), len(data)) == data
    assert len(compress(bytes(100_000))) > 100_000 / MAX_RATIO
    assert unpacked(b"\x00a\xe0\xff\x00", 264 + 1) == b"a" * 265


@settings(deadline=None, max_examples=100)
@given(data=st.binary(max_size=60), size=st.integers(0, 3000))
def test_lzf_equals_twin_on_any_bytes(data, size):
    expected = naive.decompress_lzf(data)
    found = unpacked(data, size)
    if expected is None or len(expected) > size:
        assert found is None
    else:
        assert found == expected
