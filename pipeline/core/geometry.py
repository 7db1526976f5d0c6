"""Rotations, rigid motions, planes, and numbers on a line: small, exact, NumPy and plain numbers only. Frames and signs as in `types`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import F64


def skew(v: F64) -> F64:
    """Return the (3, 3) matrix of the cross product: `skew(v) @ x = v × x`."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def exp_so3(phi: F64) -> F64:
    """Map a (3,) rotation vector (rad) to its (3, 3) rotation (Rodrigues)."""
    x, y, z = phi.tolist()  # plain numbers: NumPy takes five times as long for so few
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-12:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = math.sqrt(angle2)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    xy, xz, yz = b * (x * y), b * (x * z), b * (y * z)
    x2, y2, z2, x, y, z = x * x, y * y, z * z, a * x, a * y, a * z
    return np.array([[1.0 - b * (y2 + z2), xy - z, xz + y], [xy + z, 1.0 - b * (x2 + z2), yz - x], [xz - y, yz + x, 1.0 - b * (x2 + y2)]])


def log_so3(R: F64) -> F64:
    """Map a (3, 3) rotation to its (3,) rotation vector, angle in [0, π]; inverse of `exp_so3`."""
    x, y, z, w = _quaternion(R)
    s = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 / w if s < 1e-9 else 2.0 * math.atan2(s, w) / s
    return np.array([factor * x, factor * y, factor * z])


def left_jacobian_so3(phi: F64) -> F64:
    """Return the left Jacobian V (3, 3) of SO(3): `exp_se3(rho, phi).t = V rho`."""
    angle2 = float(phi @ phi)
    angle = np.sqrt(angle2)
    K = skew(phi)
    if angle2 < 1e-10:
        return np.eye(3) + 0.5 * K + K @ K / 6.0
    a, b = (1.0 - np.cos(angle)) / angle2, (angle - np.sin(angle)) / (angle2 * angle)
    return np.asarray(np.eye(3) + a * K + b * (K @ K), np.float64)


def exp_se3(xi: F64) -> F64:
    """Map a (6,) twist (rho, phi) to its (4, 4) rigid motion."""
    return pose_matrix(exp_so3(xi[3:]), left_jacobian_so3(xi[3:]) @ xi[:3])


def log_se3(T: F64) -> F64:
    """Map a (4, 4) rigid motion to its (6,) twist (rho, phi); inverse of `exp_se3`."""
    phi = log_so3(T[:3, :3])
    return np.concatenate([np.linalg.solve(left_jacobian_so3(phi), T[:3, 3]), phi])


def adjoint(T: F64) -> F64:
    """Return the adjoints (..., 6, 6) of (..., 4, 4) rigid motions: `T Exp(xi) T⁻¹ = Exp(Ad xi)`, translation first."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = -np.cross(R, t[..., None], axisa=-2, axisb=-2, axisc=-2)
    return out


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
    out[..., :3, 3:] = -(R @ T[..., :3, 3:])
    out[..., 3, 3] = 1.0
    return out


def transform(T_a_b: F64, points_b: F64) -> F64:
    """Transform (..., 3) points of frame b into frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def transform_each(T_a_b: F64, points_b: F64) -> F64:
    """Transform (n, k, 3) points of frame b into frame a, each row by its own motion (n, 4, 4)."""
    return points_b @ T_a_b[:, :3, :3].swapaxes(-1, -2) + T_a_b[:, None, :3, 3]


def transform_planes(T_a_b: F64, planes_b: F64) -> F64:
    """Transform (..., 4) planes (n, d) of frame b into frame a, signs as they are: d may become negative."""
    n = planes_b[..., :3] @ T_a_b[:3, :3].T
    return np.concatenate([n, planes_b[..., 3:] - (n @ T_a_b[:3, 3])[..., None]], axis=-1)


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
    """Return the rotation nearest to a (3, 3) matrix in the Frobenius norm (SVD with determinant +1)."""
    U, _, Vt = np.linalg.svd(M)
    U[:, 2] *= np.linalg.det(U @ Vt)
    return np.asarray(U @ Vt, np.float64)


def rotation_angle_deg(R: F64) -> float:
    """Return the angle of a rotation in degrees, accurate near 0."""
    return math.degrees(math.hypot(*log_so3(R).tolist()))


def quaternion_from_rotation(R: F64) -> F64:
    """Convert a (3, 3) rotation to the unit quaternion (x, y, z, w) with w >= 0, by the largest diagonal term (no cancellation)."""
    return np.array(_quaternion(R))


def _quaternion(R: F64) -> tuple[float, float, float, float]:
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


def umeyama(estimate: F64, truth: F64) -> F64:
    """Align (n, 3) points by SE(3): the T (4, 4) that minimises `Σ |truth - T estimate|²` (Umeyama 1991, scale fixed to 1)."""
    mean_e, mean_t = estimate.mean(axis=0), truth.mean(axis=0)
    U, _, Vt = np.linalg.svd((truth - mean_t).T @ (estimate - mean_e))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))]) @ Vt
    return pose_matrix(R, mean_t - R @ mean_e)


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
