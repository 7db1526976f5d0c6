"""Strength and orientation of corners, from the pixels of an image one row after another."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, U8

HARRIS_K = 0.04  # Harris & Stephens (1988), the usual value
BLOCK = 3  # half side of the window of gradients
PATCH = 15  # radius of the disc the orientation is taken from (Rublee et al., ICCV 2011)
ROW = 32  # px looked at in a row of the disc: a constant that the compiler can take several of at once; the last counts nothing


@numba.njit(cache=True, nogil=True, error_model="numpy")
def harris_score(pixels: U8, corner: int, cols: int) -> float:
    """Harris measure `det - k trace²` of the gradients (Sobel) in the 7 × 7 window around a pixel, given by its unsigned place in rows of `cols`, and
    at least 5 px from the border."""
    a, b, c = np.int32(0), np.int32(0), np.int32(0)
    first = corner - np.uint64(BLOCK + 1) * cols - np.uint64(BLOCK + 1)
    for q in range(np.uint64(2 * BLOCK + 2)):  # columns side by side; the last counts nothing
        aa, ab, bb = np.int32(0), np.int32(0), np.int32(0)
        for r in range(np.uint64(2 * BLOCK + 1)):
            u = first + r * cols + q
            m, d = u + cols, u + cols + cols
            nw, n, ne = np.int32(pixels[u]), np.int32(pixels[u + np.uint64(1)]), np.int32(pixels[u + np.uint64(2)])
            w, e = np.int32(pixels[m]), np.int32(pixels[m + np.uint64(2)])
            sw, s, se = np.int32(pixels[d]), np.int32(pixels[d + np.uint64(1)]), np.int32(pixels[d + np.uint64(2)])
            gx, gy = np.int32(ne - nw + 2 * (e - w) + se - sw), np.int32(sw - nw + 2 * (s - n) + se - ne)
            aa, ab, bb = np.int32(aa + gx * gx), np.int32(ab + gx * gy), np.int32(bb + gy * gy)
        inside = np.int32(q < 2 * BLOCK + 1)
        a, b, c = np.int32(a + aa * inside), np.int32(b + ab * inside), np.int32(c + bb * inside)
    scale = 1.0 / (4.0 * 49.0 * 255.0)
    p, q2, t = a * scale, c * scale, b * scale
    return p * q2 - t * t - HARRIS_K * (p + q2) * (p + q2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def half_disc() -> tuple[F32, F32]:
    """For `centroid_angle`: of the pixels in rows 0 … `PATCH` of the disc, each `ROW` from column -`PATCH`, how far they are to the right, and 1;
    0 for those outside. Row 0 counts half, for it is taken twice."""
    across, inside = np.zeros((PATCH + 1) * ROW, np.float32), np.zeros((PATCH + 1) * ROW, np.float32)
    for v in range(PATCH + 1):
        half = int(np.rint(np.sqrt(PATCH * PATCH - v * v)))
        for u in range(-half, half + 1):
            inside[v * ROW + PATCH + u] = 1.0 if v > 0 else 0.5
            across[v * ROW + PATCH + u] = u * inside[v * ROW + PATCH + u]
    return across, inside


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc"})  # the sums are of small integers: exact in any order
def centroid_angle(pixels: U8, corner: int, cols: int, across: F32, inside: F32) -> float:
    """Direction from a pixel to the intensity centroid of the disc around it, degrees in [0, 360), x right and y down.

    The pixel is given by its unsigned place in rows of `cols`, and at least `PATCH` + 1 px from the border; `across` and `inside` as from
    `half_disc`."""
    mx, my = 0.0, 0.0
    above = corner - np.uint64(PATCH)
    below = above
    for v in range(np.uint64(PATCH + 1)):
        moment, more = np.float32(0.0), np.float32(0.0)
        for k in range(np.uint64(ROW)):
            up, down, i = np.float32(pixels[above + k]), np.float32(pixels[below + k]), v * np.uint64(ROW) + k
            moment += (up + down) * across[i]
            more += (down - up) * inside[i]
        mx += moment
        my += float(v) * more
        above, below = above - cols, below + cols
    angle = np.degrees(np.arctan2(my, mx))
    return angle + 360.0 if angle < 0.0 else angle
