"""Planes on the axes of a Manhattan frame: which stand at right angles, and the rotation nearest to those on the axes."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.axes.minimal_frames import best_frame, frames_through
from trihedron.plugins.numerics.axes.procrustes import normal_covariance, procrustes, square_angles
from trihedron.plugins.numerics.axes.sphere_modes import assign_axes


class Walls(NamedTuple):
    """n planes whose normals are known."""

    normals: F64  # (n, 3)
    spatial: F64  # (n, 3, 3) their covariances, rad²
    variance: F64  # (n,) in a tangent coordinate, the mean of the two
    area: F64  # (n,) px


@numba.njit(cache=True, nogil=True, error_model="numpy")
def known_walls(planes: F64, covariance: F64, pixels: I32, floor: float) -> Walls:
    """Of planes (n, 4) with `covariance` (n, 3, 3) of (a, b, d) those whose normals are known; `floor` (rad) is added in square."""
    spatial = normal_covariance(planes, covariance, floor)
    variance = np.empty(len(planes))
    for i in range(len(planes)):
        variance[i] = 0.5 * (spatial[i, 0, 0] + spatial[i, 1, 1] + spatial[i, 2, 2])
    good = np.flatnonzero(np.isfinite(variance) & (variance > 0.0) & (pixels > 0))
    return Walls(np.ascontiguousarray(planes[good, :3]), spatial[good], variance[good], pixels[good].astype(np.float64))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def perpendicular_pair(walls: Walls, max_cos: float, largest_cos: float, reach: float, before: F64, loyalty: float) -> tuple[bool, F64]:
    """Whether two walls stand at right angles (`max_cos` and twice their uncertainty, at most `largest_cos`), and the rotation through the pair that
    explains most area within `reach`, see `best_frame`."""
    n, count = len(walls.normals), 0
    first, second = np.empty((n * n, 3)), np.empty((n * n, 3))
    for i in range(n):
        for j in range(i + 1, n):
            a, b = walls.normals[i], walls.normals[j]
            sigma = np.sqrt(walls.variance[i] + walls.variance[j])
            if abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) <= min(max_cos + 2.0 * sigma, largest_cos):
                swap = walls.variance[j] < walls.variance[i]  # the first axis is the better known
                first[count], second[count] = (b, a) if swap else (a, b)
                count += 1
    if count == 0:
        return False, before.copy()
    frames = frames_through(first[:count], second[:count])
    return True, best_frame(frames, walls.normals, walls.area, np.full(n, reach), before, loyalty)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def area_on_axes(walls: Walls, R: F64, reach: float) -> F64:
    """(3,) of the walls within `reach` of each column of R."""
    out, axes = np.zeros(3), assign_axes(walls.normals, R, reach)
    for i in range(len(axes)):
        if axes[i] >= 0:
            out[axes[i]] += walls.area[i]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def settled(walls: Walls, R: F64, reach: float, gate: float, prior: float, rounds: int) -> tuple[F64, I32, F64]:
    """From R the rotation nearest to the walls within `reach` of its axes, again with new axes and with Cauchy weights, one half at `gate` σ: the
    rotation, the axis of each wall (n,), -1 for none, and its weight (n,), 1/rad²."""
    axes, weights = assign_axes(walls.normals, R, reach), 1.0 / walls.variance
    for _ in range(rounds):
        R = procrustes(walls.normals, weights, axes, R, prior)
        axes = assign_axes(walls.normals, R, reach)
        weights = 1.0 / (walls.variance + square_angles(walls.normals, axes, R) / gate**2)
    return R, axes, weights
