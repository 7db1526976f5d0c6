"""Small dense algebra for numba loops, written out: it compiles in a fraction of the time of NumPy's."""

from __future__ import annotations

from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.types import F32, F64, Camera
from trihedron.plugins.shared.linalg_kernels import invert_each

# Arrays as kernels read them.


def constant(array: Any, dtype: type[np.generic]) -> Any:
    """The array, contiguous and of an element type, as a view that cannot be written. To numba that is a type of its own, and the arrays of values
    have it: without this a kernel would be compiled anew for each mixture of them with computed ones, seconds later in the middle of a run."""
    view = np.ascontiguousarray(array, dtype).view()
    view.flags.writeable = False
    return view


# Covariances of what an RGB-D camera measures, and how they move between frames.


def point_covariance(points_m: F64, sigma_px: F64, sigma_m: F64, camera: Camera) -> F64:
    """(..., 3, 3) covariance (camera frame) of back-projected points (..., 3): `sigma_px` across the ray, `sigma_m` of the depth, both (...)."""
    z = points_m[..., 2]
    ray = points_m / z[..., None]
    covariance = (sigma_m**2)[..., None, None] * ray[..., :, None] * ray[..., None, :]
    covariance[..., 0, 0] += (z * sigma_px / camera.fx) ** 2
    covariance[..., 1, 1] += (z * sigma_px / camera.fy) ** 2
    return covariance


def inverse(matrices: F32 | F64) -> F64:
    """(..., k, k) inverses of symmetric matrices: covariances of information matrices or the other way round. LinAlgError if one is singular."""
    if matrices.shape[-1] != 3:
        return np.asarray(np.linalg.inv(matrices.astype(np.float64)), np.float64)
    out = np.array(matrices, np.float64, order="C")
    if not invert_each(out.reshape(-1, 3, 3)):
        raise np.linalg.LinAlgError("Singular matrix")
    return out


def rotate_covariance(R_a_b: F64, covariance_b: F64) -> F64:
    """(..., 3, 3) covariance of frame b in frame a."""
    return R_a_b @ covariance_b @ R_a_b.T


def cross_matrices(points: F64) -> F64:
    """(..., 3) -> (..., 3, 3) with `cross_matrices(p) @ x = p × x`."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def moved_covariance(points: F64, pose_covariance: F64) -> F64:
    """(..., 3, 3): what an uncertain pose, (6, 6) of xi = (rho, phi), does to camera-frame points (..., 3)."""
    J = np.concatenate([np.broadcast_to(np.eye(3), (*points.shape[:-1], 3, 3)), -cross_matrices(points)], axis=-1)
    return J @ pose_covariance @ np.swapaxes(J, -1, -2)


def transform_plane_covariance(T_a_b: F64, planes_b: F64, planes_a: F64, covariance_b: F64) -> F64:
    """(n, 3, 3) covariance of (a, b, d) in frame a, for planes (n, 4) of frame b and the same ones in frame a (`geometry.transform_planes`)."""
    turned = T_a_b[:3, :3] @ tangent_basis(planes_b[:, :3])  # (n, 3, 2): how the normal of frame a moves
    F = np.zeros((len(planes_b), 3, 3))
    F[:, :2, :2] = np.swapaxes(tangent_basis(planes_a[:, :3]), -1, -2) @ turned
    F[:, 2, :2] = -T_a_b[:3, 3] @ turned
    F[:, 2, 2] = 1.0
    return F @ covariance_b @ np.swapaxes(F, -1, -2)
