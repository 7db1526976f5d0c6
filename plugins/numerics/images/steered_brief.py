"""Binary descriptors of oriented key points: steered BRIEF."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, I32, U8
from trihedron.plugins.numerics.images.image_pyramid import Pyramid

BITS = 256
REACH_PX = 15  # of a test's ends from the key point: patches of 31 px (Rublee et al.)
LONGEST_PX = 9.0  # between a test's ends: as many bits differ between images of one place, and of two, as with tests that were learned
WINDOW_PX = 7  # side of the square each end of a test is the mean of
AREA = WINDOW_PX * WINDOW_PX


def brief_tests(seed: int = 0) -> F32:
    """(4, 256) ends (x1, y1, x2, y2) in px about the key point: drawn evenly from the disc, not further apart than `LONGEST_PX`."""
    rng = np.random.default_rng(seed)
    tests: list[F32] = []
    while len(tests) < BITS:
        x1, y1, x2, y2 = np.round(rng.uniform(-REACH_PX, REACH_PX, 4))
        if max(np.hypot(x1, y1), np.hypot(x2, y2)) <= REACH_PX and 1.0 <= np.hypot(x1 - x2, y1 - y2) <= LONGEST_PX:
            tests.append(np.array([x1, y1, x2, y2], np.float32))
    return np.stack(tests, axis=1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def steered_brief(pyramid: Pyramid, cells: I32, levels: I32, angles_deg: F32, tests: F32) -> U8:
    """(n, 32) descriptors of the pixels (n, 2) of their levels (n,), none nearer to a border than `REACH_PX` and half a window.

    Bit i is whether the mean about the first end of test i is darker than that about the second, the tests turned by the key point's angle
    (Calonder et al., ECCV 2010; Rublee et al., ICCV 2011)."""
    smooth = np.empty_like(pyramid.pixels)
    for level in range(len(pyramid.shapes)):
        h, w = pyramid.shapes[level]
        _window_means(pyramid.pixels, np.uint64(pyramid.starts[level]), np.uint64(h), np.uint64(w), smooth)
    out = np.zeros((len(cells), BITS // 8), np.uint8)
    first, second = np.empty(BITS, np.int32), np.empty(BITS, np.int32)
    for i in range(len(cells)):
        angle = np.radians(angles_deg[i])
        c, s, width = np.cos(angle), np.sin(angle), pyramid.shapes[levels[i], 1]
        _places(tests[0], tests[1], c, s, width, first)
        _places(tests[2], tests[3], c, s, width, second)
        around = smooth[pyramid.starts[levels[i]] + (cells[i, 1] - REACH_PX - 1) * width :]
        centre = (REACH_PX + 1) * width + cells[i, 0]
        for byte in range(BITS // 8):
            bits = 0
            for k in range(8):
                bits |= (around[centre + first[8 * byte + k]] < around[centre + second[8 * byte + k]]) << k
            out[i, byte] = bits
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _window_means(pixels: U8, start: int, h: int, w: int, out: U8) -> None:
    """Writes the rounded mean of the window about each pixel of a level, but for those less than half a window from its border. Two bytes hold what
    is summed, and unsigned indices do not count from the end, so that the compiler takes 32 pixels at a time."""
    side, half = np.uint64(WINDOW_PX), np.uint64(WINDOW_PX // 2)
    if h < side or w < side:
        return
    columns = np.zeros(w, np.uint16)  # sums over the window's rows
    for r in range(side):
        for c in range(w):
            columns[c] += pixels[start + r * w + c]
    for r in range(half, h - half):
        here = start + r * w
        for c in range(w - side + np.uint64(1)):
            total = np.uint16(AREA // 2)
            for k in range(side):
                total = np.uint16(total + columns[c + k])
            out[here + half + c] = total // np.uint16(AREA)
        if r + half + np.uint64(1) < h:
            old, new = here - half * w, here + (half + np.uint64(1)) * w
            for c in range(w):
                columns[c] = np.uint16(np.uint16(columns[c] + pixels[new + c]) - pixels[old + c])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _places(x: F32, y: F32, c: float, s: float, width: int, out: I32) -> None:
    """Writes how many pixels after the centre the turned ends (n,) lie, in rows of `width`."""
    for k in range(len(out)):
        row = np.int32(np.rint(x[k] * s + y[k] * c))
        out[k] = row * width + np.int32(np.rint(x[k] * c - y[k] * s))
