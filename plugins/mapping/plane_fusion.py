"""Plane landmarks from the summed moments of all their observations."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.linalg import eigh, inv_symmetric, matmul
from trihedron.pipeline.core.types import F32, F64
from trihedron.plugins.shared.covariances import cross_matrices


def information_of(moments: F64, coefficients: F64) -> F64:
    """Return the information (n, 3, 3) of moments (n, 4, 4) about (a, b, d) of planes (n, 4): `Jᵀ M J` with J the Jacobian of (n, d)."""
    J = np.zeros((len(moments), 4, 3))
    J[:, :3, :2] = tangent_basis(coefficients[:, :3])
    J[:, 3, 2] = 1.0
    return matmul(np.swapaxes(J, -1, -2), moments, J)


def equivalent_moments(coefficients: F64, covariance: F64) -> F64:
    """Return moments (n, 4, 4) with the plane `coefficients` (n, 4) and with the inverse of `covariance` (n, 3, 3) as information about (a, b, d).

    `M = Lᵀ C⁻¹ L`, where L takes (n', d') to its (a, b, d) about the plane, homogeneous in scale. The moments of a region's own points would be
    biased: its pixels are not independent, and least squares through points with errors along their rays tilts a slanted plane."""
    n, d = coefficients[:, :3], coefficients[:, 3]
    L = np.zeros((len(n), 3, 4))
    L[:, :2, :3] = np.swapaxes(tangent_basis(n), -1, -2)
    L[:, 2, :3] = -d[:, None] * n
    L[:, 2, 3] = 1.0
    return matmul(np.swapaxes(L, -1, -2), inv_symmetric(covariance), L)


def move_moments(T_a_b: F64, moments_b: F64) -> F64:
    """Transform moments (n, 4, 4) of points into frame a."""
    return matmul(T_a_b, moments_b, T_a_b.T)


def fit_planes(moments: F64, like: F64) -> tuple[F64, F64]:
    """Fit planes (n, 4) to moments (n, 4, 4) by least squares, with covariance (n, 3, 3); their normals point to the side of `like` (n, 4)."""
    weight = moments[:, 3, 3]
    centre = moments[:, :3, 3] / weight[:, None]
    scatter = moments[:, :3, :3] - weight[:, None, None] * centre[:, :, None] * centre[:, None, :]
    normal = np.asarray(eigh(scatter)[1][:, :, 0], np.float64)
    normal = normal * np.where(np.einsum("ij,ij->i", normal, like[:, :3]) < 0.0, -1.0, 1.0)[:, None]
    planes = np.concatenate([normal, -np.einsum("ij,ij->i", normal, centre)[:, None]], axis=1)
    return planes, inv_symmetric(information_of(moments, planes))


def motions_between(old: F64, new: F64, centres: F64) -> F64:
    """Return the smallest motions (n, 4, 4) that take planes `old` (n, 4) to `new` (n, 4), rotating about the points `centres` (n, 3) of the old
    ones.

    With v = a × b and c = a · b of the two normals the rotation is `1 + [v] + [v]² / (1 + c)`."""
    K = cross_matrices(np.cross(old[:, :3], new[:, :3]))
    cosine = np.einsum("ij,ij->i", old[:, :3], new[:, :3])
    T = np.zeros((len(old), 4, 4))
    T[:, :3, :3] = R = np.eye(3) + K + matmul(K, K) / np.maximum(1.0 + cosine, 1e-12)[:, None, None]
    away = np.einsum("ij,ij->i", new[:, :3], centres) + new[:, 3]
    T[:, :3, 3] = centres - np.einsum("nij,nj->ni", R, centres) - away[:, None] * new[:, :3]
    T[:, 3, 3] = 1.0
    return T


def project_to_planes(samples: F32, planes: F64) -> F32:
    """Project samples (n, s, 3) onto their planes (n, 4)."""
    distance = np.einsum("nsj,nj->ns", samples, planes[:, :3]) + planes[:, None, 3]
    return np.asarray(samples - distance[..., None] * planes[:, None, :3], np.float32)
