"""Strength and orientation of corners at given pixels."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, I32, U8

HARRIS_K = 0.04  # Harris & Stephens (1988), the usual value
BLOCK = 3  # half side of the window of gradients
PATCH = 15  # radius of the disc the orientation is taken from (Rublee et al., ICCV 2011)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def harris_scores(image: U8, corners: I32) -> F32:
    """(n,) Harris measure `det - k trace²` of the gradients (Sobel) in the 7 × 7 window around (n, 2) pixels (x, y).

    Closer than 4 px to the border it is 0."""
    rows, cols = image.shape
    out = np.zeros(len(corners), np.float32)
    for i in range(len(corners)):
        x, y = corners[i, 0], corners[i, 1]
        if x < BLOCK + 1 or y < BLOCK + 1 or x >= cols - BLOCK - 1 or y >= rows - BLOCK - 1:
            continue
        a, b, c = 0, 0, 0
        for r in range(y - BLOCK, y + BLOCK + 1):
            for q in range(x - BLOCK, x + BLOCK + 1):
                nw, n, ne = np.int64(image[r - 1, q - 1]), np.int64(image[r - 1, q]), np.int64(image[r - 1, q + 1])
                w, e = np.int64(image[r, q - 1]), np.int64(image[r, q + 1])
                sw, s, se = np.int64(image[r + 1, q - 1]), np.int64(image[r + 1, q]), np.int64(image[r + 1, q + 1])
                gx, gy = ne - nw + 2 * (e - w) + se - sw, sw - nw + 2 * (s - n) + se - ne
                a += gx * gx
                b += gx * gy
                c += gy * gy
        scale = 1.0 / (4.0 * 49.0 * 255.0)
        p, q2, t = a * scale, c * scale, b * scale
        out[i] = p * q2 - t * t - HARRIS_K * (p + q2) * (p + q2)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc"})  # the sums are of small integers: exact in any order
def centroid_angles_deg(image: U8, corners: I32) -> F32:
    """(n,) direction from each (n, 2) pixel to the intensity centroid of the disc around it, degrees in [0, 360), x right and y down."""
    rows, cols = image.shape
    out = np.zeros(len(corners), np.float32)
    half = np.empty(PATCH + 1, np.int64)
    offset = np.arange(-PATCH, PATCH + 1).astype(np.float32)
    for v in range(PATCH + 1):
        half[v] = int(np.rint(np.sqrt(PATCH * PATCH - v * v)))
    for i in range(len(corners)):
        x, y = corners[i, 0], corners[i, 1]
        mx, my = 0.0, 0.0
        for v in range(max(-PATCH, -y), min(PATCH, rows - 1 - y) + 1):
            low, high = max(-half[abs(v)], -x), min(half[abs(v)], cols - 1 - x)
            line, across = image[y + v, x + low : x + high + 1], offset[PATCH + low : PATCH + high + 1]
            total, moment = np.float32(0.0), np.float32(0.0)
            for k in range(len(line)):
                value = np.float32(line[k])
                total += value
                moment += value * across[k]
            mx += moment
            my += v * total
        angle = np.degrees(np.arctan2(my, mx))
        out[i] = angle + 360.0 if angle < 0.0 else angle
    return out
