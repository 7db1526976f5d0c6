"""Rotations through two directions at right angles, and how much stands on their axes."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, Bool
from trihedron.plugins.numerics.axes.cube_symmetry import nearest_equivalent

NEAR = np.radians(15.0)  # a frame turned less than this from the previous axes is still the same


@numba.njit(cache=True, nogil=True, error_model="numpy")
def frames_through(first: F64, second: F64) -> F64:
    """(m, 3, 3) rotations whose first columns are the unit vectors `first` (m, 3), and whose second lie in the plane of these and `second` (m, 3),
    which must not be parallel to them."""
    out = np.empty((len(first), 3, 3))
    for i in range(len(first)):
        dot = first[i, 0] * second[i, 0] + first[i, 1] * second[i, 1] + first[i, 2] * second[i, 2]
        norm = 0.0
        for k in range(3):
            out[i, k, 0], out[i, k, 1] = first[i, k], second[i, k] - dot * first[i, k]
            norm += out[i, k, 1] ** 2
        for k in range(3):
            out[i, k, 1] /= np.sqrt(norm)
        for k in range(3):
            p, q = (k + 1) % 3, (k + 2) % 3
            out[i, k, 2] = out[i, p, 0] * out[i, q, 1] - out[i, q, 0] * out[i, p, 1]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def score_frames(frames: F64, directions: F64, weights: F64, reach: F64) -> F64:
    """(m,) weight of the directions (n, 3) near an axis of each frame (m, 3, 3), falling off with the squared angle to 0 at `reach` (n,) rad (MSAC:
    Torr and Zisserman 2000)."""
    out = np.zeros(len(frames))
    for i in range(len(directions)):
        x, y, z, narrow = directions[i, 0], directions[i, 1], directions[i, 2], 1.0 / np.sin(reach[i]) ** 2
        for m in range(len(frames)):
            best = 0.0
            for k in range(3):
                dot = x * frames[m, 0, k] + y * frames[m, 1, k] + z * frames[m, 2, k]
                best = max(best, dot * dot)
            out[m] += weights[i] * max(1.0 - max(1.0 - best, 0.0) * narrow, 0.0)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def same_axes(frames: F64, R: F64) -> Bool:
    """(m,) whether each axis of R (3, 3) is within `NEAR` of one of the frame (m, 3, 3)."""
    out = np.ones(len(frames), np.bool_)
    for m in range(len(frames)):
        for j in range(3):
            best = 0.0
            for k in range(3):
                best = max(best, abs(frames[m, 0, k] * R[0, j] + frames[m, 1, k] * R[1, j] + frames[m, 2, k] * R[2, j]))
            out[m] = out[m] and best > np.cos(NEAR)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def best_frame(frames: F64, directions: F64, weights: F64, reach: F64, before: F64, loyalty: float) -> F64:
    """The frame (3, 3) with the highest `score_frames`, named as is nearest to the previous axes `before` (3, 3); frames with the same axes as these
    count `loyalty` times."""
    score = score_frames(frames, directions, weights, reach)
    if loyalty != 1.0:
        score *= np.where(same_axes(frames, before), loyalty, 1.0)
    return nearest_equivalent(frames[np.argmax(score)], before)
