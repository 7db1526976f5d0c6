"""Rotations, rigid motions, planes, and numbers on a line: small and exact. Frames and signs as in `types`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.linalg_kernels import polar_rotation
from trihedron.pipeline.core.types import F64

CAMERA_UP, CAMERA_AHEAD = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])  # of the first frame, which is the world
ROUNDING = 1e-12  # of RRᵀ - I, above which a rotation is made one again


def pose_matrix(R: F64, t: F64) -> F64:
    """Compose a rotation (3, 3) and a translation (3,) into a (4, 4) matrix."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def invert(T: F64) -> F64:
    """Invert (..., 4, 4) rigid motions."""
    R = T[..., :3, :3].swapaxes(-1, -2)
    out = np.zeros(T.shape)
    out[..., :3, :3] = R
    out[..., :3, 3:] = -matmul(R, T[..., :3, 3:])
    out[..., 3, 3] = 1.0
    return out


def transform(T_a_b: F64, points_b: F64) -> F64:
    """Transform (..., 3) points of frame b into frame a."""
    return matmul(points_b, T_a_b[:3, :3].T) + T_a_b[:3, 3]


def transform_each(T_a_b: F64, points_b: F64) -> F64:
    """Transform (n, k, 3) points of frame b into frame a, each row by its own motion (n, 4, 4)."""
    return matmul(points_b, T_a_b[:, :3, :3].swapaxes(-1, -2)) + T_a_b[:, None, :3, 3]


def transform_planes(T_a_b: F64, planes_b: F64) -> F64:
    """Transform (..., 4) planes (n, d) of frame b into frame a, signs as they are: d may become negative."""
    n = matmul(planes_b[..., :3], T_a_b[:3, :3].T)
    return np.concatenate([n, planes_b[..., 3:] - matmul(n, T_a_b[:3, 3])[..., None]], axis=-1)


def tangent_basis(n: F64) -> F64:
    """Return, for (..., 3) unit vectors, (..., 3, 2): two orthonormal columns spanning the plane normal to n.

    A function of n alone, but it jumps where n_z changes sign: compare two normals in the basis of one of them, never each in its own."""
    x, y, z = n[..., 0], n[..., 1], n[..., 2]
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    out = np.empty((*n.shape, 2))
    out[..., 0, 0], out[..., 1, 0], out[..., 2, 0] = 1.0 + sign * x * x * a, sign * b, -sign * x
    out[..., 0, 1], out[..., 1, 1], out[..., 2, 1] = b, sign + y * y * a, -y
    return out


def nearest_rotation(M: F64) -> F64:
    """Return the rotation nearest to a (3, 3) matrix in the Frobenius norm (determinant +1), by its polar decomposition."""
    return polar_rotation(np.array(M, np.float64, order="C"))


def rigid(T: F64) -> F64:
    """Return the motion (4, 4) with the rotation nearest to its own; the same array within rounding.

    `invert` takes the transpose for the inverse, which doubles a rotation's rounding error: in a chain of poses, each relative to the one before, it
    would grow without bound."""
    R = T[:3, :3]
    return T if np.abs(matmul(R, R.T) - np.eye(3)).max() < ROUNDING else pose_matrix(nearest_rotation(R), T[:3, 3])


def quaternion_from_rotation(R: F64) -> F64:
    """Convert a (3, 3) rotation to the unit quaternion (x, y, z, w) with w >= 0, by the largest diagonal term (no cancellation)."""
    return np.array(quaternion_xyzw(R))


def quaternion_xyzw(R: F64) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w), w ≥ 0, of a rotation (3, 3), as plain numbers."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    trace = a + e + i
    largest = max(a, e, i, trace)
    if largest == a:
        x, y, z, w = 1.0 + a - e - i, b + d, c + g, h - f
    elif largest == e:
        x, y, z, w = b + d, 1.0 + e - i - a, f + h, c - g
    elif largest == i:
        x, y, z, w = c + g, f + h, 1.0 + i - a - e, d - b
    else:
        x, y, z, w = h - f, c - g, d - b, 1.0 + trace
    norm = math.copysign(math.sqrt(x * x + y * y + z * z + w * w), w)
    return x / norm, y / norm, z / norm, w / norm


def rotation_from_quaternion(q: F64) -> F64:
    """Convert a (4,) quaternion (x, y, z, w), normalised here, to a (3, 3) rotation. Raises ValueError for a zero or non-finite one."""
    x, y, z, w = q.tolist()
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not math.isfinite(norm) or norm < 1e-9:
        raise ValueError("not a rotation: the quaternion is zero or not finite")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def upright(up: F64, axis: str = "z") -> F64:
    """Return (3, 3) `R_file_world` for the up direction (3,) of the world, NaN = that of the first camera: up becomes `axis`, "z" or "y", and the
    first camera looks along +y, or -z."""
    up = up / np.sqrt((up * up).sum()) if np.isfinite(up).all() else CAMERA_UP
    ahead = CAMERA_AHEAD - (CAMERA_AHEAD * up).sum() * up
    if (ahead * ahead).sum() < 0.01:  # the first camera looked straight up or down
        ahead = CAMERA_UP - (CAMERA_UP * up).sum() * up
    ahead = ahead / np.sqrt((ahead * ahead).sum())
    right = np.cross(ahead, up)
    return np.stack([right, ahead, up]) if axis == "z" else np.stack([right, up, -ahead])


def umeyama(estimate: F64, truth: F64) -> F64:
    """Align (n, 3) points by SE(3): the T (4, 4) that minimises `Σ |truth - T estimate|²` (Umeyama 1991, scale fixed to 1)."""
    mean_e, mean_t = estimate.mean(axis=0), truth.mean(axis=0)
    R = nearest_rotation(matmul((truth - mean_t).T, estimate - mean_e))
    return pose_matrix(R, mean_t - matmul(R, mean_e))


def nearest_pairs(first: NDArray[np.int64], second: NDArray[np.int64], limit: int) -> NDArray[np.int64]:
    """Pair two increasing lists of integers: (n, 2) rows at most `limit` apart, the closest pair first, each entry at most once, ties to the
    earlier row. Sorted by the first list."""
    low = np.searchsorted(second, first - limit, side="left")
    counts = np.maximum(np.searchsorted(second, first + limit, side="right") - low, 0)
    rows = np.repeat(np.arange(len(first)), counts)
    columns = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(low, counts)
    order = np.lexsort((columns, rows, np.abs(first[rows] - second[columns])))
    rows, columns = rows[order], columns[order]
    chosen = [np.empty((0, 2), np.int64)]
    while len(rows):
        # a candidate that is the best one left for both its entries is one the greedy rule takes
        best = np.zeros(len(rows), bool)
        best[np.intersect1d(np.unique(rows, return_index=True)[1], np.unique(columns, return_index=True)[1])] = True
        chosen.append(np.stack([rows[best], columns[best]], axis=-1))
        left = ~(np.isin(rows, rows[best]) | np.isin(columns, columns[best]))
        rows, columns = rows[left], columns[left]
    pairs = np.concatenate(chosen)
    return pairs[np.argsort(pairs[:, 0], kind="stable")]
