"""Covariances of points and planes, and how they change with the pose that they are seen from."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, Camera


def point_covariance(points_m: F64, sigma_px: F64, sigma_m: F64, camera: Camera) -> F64:
    """Return the covariance (..., 3, 3), camera frame, of back-projected points (..., 3): `sigma_px` across the ray, `sigma_m` of the depth,
    (...)."""
    z = points_m[..., 2]
    ray = points_m / z[..., None]
    covariance = (sigma_m**2)[..., None, None] * ray[..., :, None] * ray[..., None, :]
    covariance[..., 0, 0] += (z * sigma_px / camera.fx) ** 2
    covariance[..., 1, 1] += (z * sigma_px / camera.fy) ** 2
    return covariance


def cross_matrices(points: F64) -> F64:
    """Return the matrices (..., 3, 3) of the cross product with points (..., 3): `cross_matrices(p) @ x = p × x`."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def pose_jacobians(points: F64) -> F64:
    """Return the Jacobians (..., 3, 6) of points `p + rho + phi × p` (..., 3) by xi = (rho, phi)."""
    return np.concatenate([np.broadcast_to(np.eye(3), (*points.shape[:-1], 3, 3)), -cross_matrices(points)], axis=-1)


def propagate_pose_covariance(points: F64, pose_covariance: F64) -> F64:
    """Return the covariance (..., 3, 3) of camera-frame points (..., 3) due to that of the pose, (6, 6) of xi = (rho, phi)."""
    J = pose_jacobians(points)
    return matmul(J, pose_covariance, np.swapaxes(J, -1, -2))


def transform_plane_covariance(T_a_b: F64, planes_b: F64, planes_a: F64, covariance_b: F64) -> F64:
    """Return the covariance (n, 3, 3) of (a, b, d) in frame a, for planes (n, 4) of frame b and the same in frame a (`geometry.transform_planes`)."""
    rotated = matmul(T_a_b[:3, :3], tangent_basis(planes_b[:, :3]))  # (n, 3, 2), basis of the normals in frame a
    F = np.zeros((len(planes_b), 3, 3))
    F[:, :2, :2] = matmul(np.swapaxes(tangent_basis(planes_a[:, :3]), -1, -2), rotated)
    F[:, 2, :2] = matmul(-T_a_b[:3, 3], rotated)
    F[:, 2, 2] = 1.0
    return matmul(F, covariance_b, np.swapaxes(F, -1, -2))
