"""The Lie groups SO(3) and SE(3): exponential and logarithmic maps, left Jacobian, adjoint. Tangent vectors are xi = (rho, phi), translation first.

Kernels have theirs in `plugins/shared/lie_kernels.py`. Reference: Barfoot, State Estimation for Robotics, chapter 7."""

from __future__ import annotations

import math

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix, quaternion_xyzw
from trihedron.pipeline.core.linalg import matmul
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
    x, y, z, w = quaternion_xyzw(R)
    s = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 / w if s < 1e-9 else 2.0 * math.atan2(s, w) / s
    return np.array([factor * x, factor * y, factor * z])


def left_jacobian_so3(phi: F64) -> F64:
    """Return the left Jacobian V (3, 3) of SO(3): `exp_se3(rho, phi).t = V rho`."""
    angle2 = float(matmul(phi, phi))
    angle = np.sqrt(angle2)
    K = skew(phi)
    if angle2 < 1e-10:
        return np.eye(3) + 0.5 * K + matmul(K, K) / 6.0
    a, b = (1.0 - np.cos(angle)) / angle2, (angle - np.sin(angle)) / (angle2 * angle)
    return np.asarray(np.eye(3) + a * K + b * matmul(K, K), np.float64)


def exp_se3(xi: F64) -> F64:
    """Map a (6,) twist (rho, phi) to its (4, 4) rigid motion."""
    return pose_matrix(exp_so3(xi[3:]), matmul(left_jacobian_so3(xi[3:]), xi[:3]))


def log_se3(T: F64) -> F64:
    """Map a (4, 4) rigid motion to its (6,) twist (rho, phi); inverse of `exp_se3`."""
    (x, y, z), (a, b, c) = log_so3(T[:3, :3]).tolist(), T[:3, 3].tolist()  # plain numbers: NumPy takes nine times as long for so few
    angle2 = x * x + y * y + z * z
    half = 0.5 * math.sqrt(angle2)
    factor = 1.0 / 12.0 + angle2 / 720.0 if angle2 < 1e-4 else (1.0 - half / math.tan(half)) / angle2
    u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
    a, b, c = a - 0.5 * u, b - 0.5 * v, c - 0.5 * w  # with the inverse of the left Jacobian
    return np.array([a + factor * (y * w - z * v), b + factor * (z * u - x * w), c + factor * (x * v - y * u), x, y, z])


def adjoint(T: F64) -> F64:
    """Return the adjoints (..., 6, 6) of (..., 4, 4) rigid motions: `T Exp(xi) T⁻¹ = Exp(Ad xi)`, translation first."""
    R, t = T[..., :3, :3], T[..., :3, 3, None]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # t × R; np.cross takes six times as long
        out[..., i, 3:] = t[..., j, :] * R[..., k, :] - t[..., k, :] * R[..., j, :]
    return out


def adjoint_between(T: F64, other: F64) -> F64:
    """Return the adjoints (..., 6, 6) of `T⁻¹ · other`, poses (..., 4, 4): they take xi of cameras at `other` to that of cameras at T that move with
    these."""
    return adjoint(matmul(invert(T), other))


def rotation_angle_deg(R: F64) -> float:
    """Return the angle of a rotation in degrees, accurate near 0."""
    return math.degrees(math.hypot(*log_so3(R).tolist()))
