"""Rigid alignment of pairs of 3D points: RANSAC, weighted least squares (Umeyama), and covariance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.geometry import nearest_rotation
from trihedron.pipeline.core.linalg import inv, matmul
from trihedron.pipeline.core.types import F32, F64, I32, Bool, Keypoints, Tracks
from trihedron.plugins.shared.covariances import pose_jacobians
from trihedron.plugins.shared.rigid_alignment_kernels import best_motion

RAD_PER_PX = 0.002  # of a pixel, about: 1/fx of a common camera


def tracked_point_pairs(tracks: Tracks, now: Keypoints) -> tuple[F64, F64, F64]:
    """Return points (n, 3) before and now, camera frames, and their common standard deviation (n,), of the tracks with depth in both frames."""
    rows = tracks.keypoints[:, 1]
    both = np.isfinite(tracks.points_m[:, 2]) & np.isfinite(now.points_m[rows, 2])
    before, after = tracks.points_m[both].astype(np.float64), now.points_m[rows[both]].astype(np.float64)
    return before, after, point_pair_sigma(before, after, tracks.sigma_m[both], now.sigma_m[rows[both]], now.sigma_px[rows[both]])


def point_pair_sigma(before: F64, after: F64, sigma_before: F64 | F32, sigma_after: F64 | F32, sigma_px: F64 | F32) -> F64:
    """Return the standard deviation (n,), m, of pairs of points (n, 3) from those of both depths, `sigma_before` and `sigma_after`, and of the
    pixels."""
    depth = np.hypot(sigma_before.astype(np.float64), sigma_after)
    return np.asarray(np.hypot(depth, RAD_PER_PX * sigma_px * np.maximum(before[:, 2], after[:, 2])))


def rows_with_depth(keypoints: Keypoints) -> I32:
    """Return the rows of the key points with depth."""
    return np.flatnonzero(np.isfinite(keypoints.points_m[:, 2])).astype(np.int32)


REFINEMENTS = 3


class Consensus(NamedTuple):
    """`p_after = R p_before + t`, and True (n,) for its inliers."""

    R: F64
    t: F64
    agree: Bool


def consensus(before: F64, after: F64, sigma: F64, gate: float, rounds: int, rng: np.random.Generator) -> Consensus:
    """Estimate the motion of points (n, 3) to (n, 3) with standard deviations (n,), m, by RANSAC: of `rounds` samples the one with most inliers
    within `gate` standard deviations, then fitted to these. The identity, and no inlier, for fewer than three pairs."""
    if len(before) < 3:
        return Consensus(np.eye(3), np.zeros(3), np.zeros(len(before), bool))
    samples = rng.integers(0, len(before), (rounds, 3)).astype(np.int32)
    R, t = best_motion(before, after, gate * sigma, samples)
    for _ in range(REFINEMENTS):
        agree = _distances(before, after, R, t) < gate * sigma
        if agree.sum() < 3:
            break
        R, t = fit_motion(before[agree], after[agree], sigma[agree])
    return Consensus(R, t, _distances(before, after, R, t) < gate * sigma)


def fit_motion(before: F64, after: F64, sigma: F64) -> tuple[F64, F64]:
    """Fit R (3, 3) and t (3,) by least squares, each pair weighted by 1/sigma² (Umeyama, PAMI 1991)."""
    w = 1.0 / sigma**2
    a, b = matmul(w, before) / w.sum(), matmul(w, after) / w.sum()
    R = nearest_rotation(matmul((after - b).T, (before - a) * w[:, None]))
    return R, b - matmul(R, a)


def fit_covariance(points: F64, sigma: F64) -> F64:
    """Return the covariance (6, 6) of xi = (rho, phi) in `p <- p + rho + phi × p`, of a fit to points (n, 3) with standard deviations (n,)."""
    w = 1.0 / sigma**2
    J = pose_jacobians(points)
    H = np.einsum("n,nij,nik->jk", w, J, J)
    return inv(H + 1e-6 * np.eye(6))


def _distances(before: F64, after: F64, R: F64, t: F64) -> F64:
    return np.asarray(np.linalg.norm(matmul(before, R.T) + t - after, axis=1))
