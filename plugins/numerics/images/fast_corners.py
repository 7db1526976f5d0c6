"""FAST corners with their strength, in one call that holds no lock."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import I32, U8

RADIUS = 3  # px of the circle compared with


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fast_corners(image: U8, threshold: int, margin: int) -> tuple[I32, I32]:
    """FAST-9 corners (Rosten & Drummond, ECCV 2006) of an image (h, w), in rows: pixels (n, 2) and strengths (n,).

    A pixel's strength is the largest threshold at which it is a corner; only those of at least `threshold`, stronger than their eight neighbours
    and not nearer than `margin` (at least 4) px to the border are given. So the corners at a higher threshold are those of that strength."""
    pixels, strengths = np.empty((image.size // 4, 2), np.int32), np.empty(image.size // 4, np.int32)
    n = find_corners(image, threshold, margin, pixels, strengths, 0)
    return pixels[:n].copy(), strengths[:n].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_corners(image: U8, threshold: int, margin: int, pixels: I32, strengths: I32, n: int) -> int:
    """Writes the corners of `fast_corners` to `pixels` and `strengths` from row n on; returns the row after the last. A quarter of the image's pixels
    cannot be more of them."""
    rows, cols = image.shape
    first = max(margin, RADIUS + 1) - 1  # neighbours are compared with beyond the margin
    width = cols - 2 * first
    if width < 3 or rows - 2 * first < 3:
        return n
    strength = np.zeros((3, width), np.uint8)  # of the last three rows
    peaks = np.zeros(-(-width // 8) * 8, np.uint8)  # of a row, looked through eight at a time
    eights = peaks.view(np.uint64)
    for y in range(first, rows - first):
        _strengths(image, y, first, strength[y % 3])
        if y < first + 2:
            continue
        _peaks(strength[(y - 2) % 3], strength[(y - 1) % 3], strength[y % 3], threshold, peaks[:width])
        for e in range(len(eights)):
            if eights[e] != 0:
                for i in range(8 * e, 8 * e + 8):
                    if peaks[i] != 0:
                        pixels[n, 0], pixels[n, 1], strengths[n] = first + i, y - 1, peaks[i]
                        n += 1
    return n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _strengths(image: U8, y: int, first: int, out: U8) -> None:
    """Writes the strength of a row's pixels from column `first`: (width,). Straight bytes, so that the compiler takes 32 pixels at a time."""
    left, right = first - RADIUS, first + len(out) + RADIUS
    d3, d2, d1 = image[y + 3, left:right], image[y + 2, left:right], image[y + 1, left:right]
    m0 = image[y, left:right]
    u1, u2, u3 = image[y - 1, left:right], image[y - 2, left:right], image[y - 3, left:right]
    for i in range(len(out)):
        c = m0[i + 3]
        p0, p1, p2, p3, p4, p5, p6, p7 = d3[i + 3], d3[i + 4], d2[i + 5], d1[i + 6], m0[i + 6], u1[i + 6], u2[i + 5], u3[i + 4]
        p8, p9, p10, p11, p12, p13, p14, p15 = u3[i + 3], u3[i + 2], u2[i + 1], u1[i], m0[i], d1[i], d2[i + 1], d3[i + 2]
        bright = _arc(p0, p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11, p12, p13, p14, p15)
        dark = _arc(
            np.uint8(~p0), np.uint8(~p1), np.uint8(~p2), np.uint8(~p3), np.uint8(~p4), np.uint8(~p5), np.uint8(~p6), np.uint8(~p7),
            np.uint8(~p8), np.uint8(~p9), np.uint8(~p10), np.uint8(~p11), np.uint8(~p12), np.uint8(~p13), np.uint8(~p14), np.uint8(~p15),
        )  # fmt: skip
        d = int(~c) & 255
        above, below = np.uint8(max(bright, c) - c), np.uint8(max(dark, d) - d)
        more = max(above, below)
        out[i] = np.uint8(max(more, np.uint8(1)) - 1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _arc(
    p0: int, p1: int, p2: int, p3: int, p4: int, p5: int, p6: int, p7: int,
    p8: int, p9: int, p10: int, p11: int, p12: int, p13: int, p14: int, p15: int,
) -> int:  # fmt: skip
    """The largest grey level that 9 neighbours in a row on the circle all reach."""
    m1, m3, m5, m7, m9, m11, m13, m15 = (
        min(p1, p2), min(p3, p4), min(p5, p6), min(p7, p8), min(p9, p10), min(p11, p12), min(p13, p14), min(p15, p0),
    )  # fmt: skip
    q1, q3, q5, q7, q9, q11, q13, q15 = (
        min(m1, m3), min(m3, m5), min(m5, m7), min(m7, m9), min(m9, m11), min(m11, m13), min(m13, m15), min(m15, m1),
    )  # fmt: skip
    r0 = min(min(q1, q5), max(p0, p9))  # 1 to 8, and 0 or 9
    r2 = min(min(q3, q7), max(p2, p11))
    r4 = min(min(q5, q9), max(p4, p13))
    r6 = min(min(q7, q11), max(p6, p15))
    r8 = min(min(q9, q13), max(p8, p1))
    r10 = min(min(q11, q15), max(p10, p3))
    r12 = min(min(q13, q1), max(p12, p5))
    r14 = min(min(q15, q3), max(p14, p7))
    return max(max(max(r0, r2), max(r4, r6)), max(max(r8, r10), max(r12, r14)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _peaks(above: U8, here: U8, below: U8, threshold: int, out: U8) -> None:
    """Writes into `out` (width,) the strengths of a row that reach the threshold and exceed their eight neighbours', else 0."""
    least = np.uint8(threshold)
    n = len(out) - 2
    inner = out[1:-1]
    b0, b1, b2 = above[:n], above[1 : n + 1], above[2:]
    h0, h1, h2 = here[:n], here[1 : n + 1], here[2:]
    u0, u1, u2 = below[:n], below[1 : n + 1], below[2:]
    for i in range(n):
        others = max(max(max(b0[i], b1[i]), max(b2[i], h0[i])), max(max(h2[i], u0[i]), max(u1[i], u2[i])))
        s = h1[i]
        inner[i] = s if (s > others) & (s >= least) else np.uint8(0)
