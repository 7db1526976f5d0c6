"""Pixels of the PNG files that data sets are made of, in half of libpng's time: chunks, zlib-ng's inflate, and the filters undone by a kernel.

Grey and RGB of 8 or 16 bits, not interlaced, without palette or transparency; all else is left to OpenCV. Nothing is allocated beyond the size that
the header claims, which `images.decode_image` holds against the number of bytes.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from trihedron.datasets.readers.png_chunks import PNG_MAGIC, chunks
from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import U8

CHANNELS = {0: 1, 2: 3}  # of the colour types that are read here
LEFT, ABOVE, MEAN, PAETH = 1, 2, 3, 4  # filters (PNG specification, section 9)


def decode_png(data: bytes) -> NDArray[Any] | None:
    """(h, w) or (h, w, 3), RGB, of 8 or 16 bits; None for what is not read here. Raises ValueError for damaged bytes."""
    width, height, bits, color, compression, filtering, interlaced = struct.unpack_from(">IIBBBBB", data, len(PNG_MAGIC) + 8)
    if color not in CHANNELS or bits not in (8, 16) or compression or filtering or interlaced:
        return None
    packed = _packed(data)
    if packed is None:
        return None
    pixel = CHANNELS[color] * bits // 8
    size = height * (width * pixel + 1)
    inflate = zlib_ng.decompressobj()
    try:
        lines = inflate.decompress(packed, size)
    except zlib_ng.error as error:  # type: ignore[misc]  # its hints take the class for an instance
        raise ValueError("its bytes do not unpack") from error
    if len(lines) != size:
        raise ValueError("it holds fewer pixels than it claims")
    out = np.empty((height, width * pixel), np.uint8)
    if not _unfiltered(np.frombuffer(lines, np.uint8).reshape(height, -1), pixel, out):
        raise ValueError("it names an unknown filter")
    values = out if bits == 8 else out.view(">u2").astype(np.uint16)
    return values.reshape(height, width, 3) if color == 2 else values


def _packed(data: bytes) -> bytes | None:
    """The compressed lines; None when a palette or transparency belongs to them. Raises ValueError for a damaged chunk."""
    parts = []
    for name, first, end in chunks(data):
        if name in (b"PLTE", b"tRNS"):
            return None
        if name in (b"IHDR", b"IDAT"):
            if zlib_ng.crc32(memoryview(data)[first - 4 : end]) != struct.unpack_from(">I", data, end)[0]:
                raise ValueError("a checksum is wrong")
            if name == b"IDAT":
                parts.append(memoryview(data)[first:end])
    return b"".join(parts)


@kernel
def _unfiltered(lines: U8, pixel: int, out: U8) -> bool:
    """Writes the bytes (h, n) of lines (h, 1 + n) that each begin with their filter; `pixel` bytes are one. False for an unknown filter."""
    h, n = out.shape
    nothing = np.zeros(n, np.uint8)
    for r in range(h):
        kind, line, here = lines[r, 0], lines[r, 1:], out[r]
        above = out[r - 1] if r > 0 else nothing
        if kind == 0:
            here[:] = line
        elif kind == LEFT:
            here[:pixel] = line[:pixel]
            for i in range(pixel, n):
                here[i] = line[i] + here[i - pixel]
        elif kind == ABOVE:
            for i in range(n):
                here[i] = line[i] + above[i]
        elif kind == MEAN:
            for i in range(pixel):
                here[i] = line[i] + (above[i] >> 1)
            for i in range(pixel, n):
                here[i] = line[i] + ((int(here[i - pixel]) + int(above[i])) >> 1)
        elif kind != PAETH:
            return False
        elif pixel == 3:
            _paeth_3(line, above, here)
        elif pixel == 2:
            _paeth_2(line, above, here)
        else:
            _paeth(line, above, pixel, here)
    return True


@kernel(inline="always")
def _nearest(a: int, b: int, c: int) -> int:
    """Whichever of the bytes to the left, above, and above to the left is nearest to a + b - c."""
    # by cases, in fewer steps than three distances: each byte waits for the one before
    rest, low, high = 3 * c - a - b, min(a, b), max(a, b)
    near = low if high <= rest else c
    return high if rest <= low else near


@kernel
def _paeth(line: U8, above: U8, pixel: int, here: U8) -> None:
    for i in range(len(here)):
        a = int(here[i - pixel]) if i >= pixel else 0
        c = int(above[i - pixel]) if i >= pixel else 0
        here[i] = line[i] + _nearest(a, int(above[i]), c)


@kernel
def _paeth_2(line: U8, above: U8, here: U8) -> None:
    """Two bytes a pixel: two chains, which a processor follows at once."""
    a0, a1, c0, c1 = 0, 0, 0, 0
    for i in range(0, len(here), 2):
        b0, b1 = int(above[i]), int(above[i + 1])
        a0 = (int(line[i]) + _nearest(a0, b0, c0)) & 255
        a1 = (int(line[i + 1]) + _nearest(a1, b1, c1)) & 255
        here[i], here[i + 1], c0, c1 = a0, a1, b0, b1


@kernel
def _paeth_3(line: U8, above: U8, here: U8) -> None:
    """Three bytes a pixel."""
    a0, a1, a2, c0, c1, c2 = 0, 0, 0, 0, 0, 0
    for i in range(0, len(here), 3):
        b0, b1, b2 = int(above[i]), int(above[i + 1]), int(above[i + 2])
        a0 = (int(line[i]) + _nearest(a0, b0, c0)) & 255
        a1 = (int(line[i + 1]) + _nearest(a1, b1, c1)) & 255
        a2 = (int(line[i + 2]) + _nearest(a2, b2, c2)) & 255
        here[i], here[i + 1], here[i + 2], c0, c1, c2 = a0, a1, a2, b0, b1, b2
