"""Tracked key points as pairs of places."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.geometry import nearest_rotation
from trihedron.pipeline.core.types import F32, F64, I32, Bool, Keypoints, Tracks
from trihedron.plugins.shared.rigid_alignment_kernels import best_kernel

RAD_PER_PX = 0.002  # of a pixel, about: 1/fx of a common camera


def tracked_point_pairs(tracks: Tracks, now: Keypoints) -> tuple[F64, F64, F64]:
    """Places (n, 3) before and now, each in its camera's axes, and their standard deviation together (n,), of the tracks with depth in both
    frames."""
    rows = tracks.keypoints[:, 1]
    both = np.isfinite(tracks.points_m[:, 2]) & np.isfinite(now.points_m[rows, 2])
    before, after = tracks.points_m[both].astype(np.float64), now.points_m[rows[both]].astype(np.float64)
    return before, after, point_pair_sigma(before, after, tracks.sigma_m[both], now.sigma_m[rows[both]], now.sigma_px[rows[both]])


def point_pair_sigma(before: F64, after: F64, sigma_before: F64 | F32, sigma_after: F64 | F32, sigma_px: F64 | F32) -> F64:
    """(n,) m, of pairs of places (n, 3) with depths known to `sigma_before` and `sigma_after`, on pixels known to `sigma_px`."""
    depth = np.hypot(sigma_before.astype(np.float64), sigma_after)
    return np.asarray(np.hypot(depth, RAD_PER_PX * sigma_px * np.maximum(before[:, 2], after[:, 2])))


def rows_with_depth(keypoints: Keypoints) -> I32:
    """Rows of the key points whose depth is known."""
    return np.flatnonzero(np.isfinite(keypoints.points_m[:, 2])).astype(np.int32)


REFINEMENTS = 3


class Consensus(NamedTuple):
    """`p_after = R p_before + t` and which pairs agree (n,)."""

    R: F64
    t: F64
    agree: Bool


def consensus(before: F64, after: F64, sigma: F64, gate: float, rounds: int, rng: np.random.Generator) -> Consensus:
    """The motion of places (n, 3) to (n, 3), each known to sigma (n,) m: of `rounds` samples the one most pairs agree with within `gate` standard
    deviations, then fitted to these. The identity, and no pair, where there are fewer than three."""
    if len(before) < 3:
        return Consensus(np.eye(3), np.zeros(3), np.zeros(len(before), bool))
    samples = rng.integers(0, len(before), (rounds, 3)).astype(np.int32)
    R, t = best_kernel(before, after, gate * sigma, samples)
    for _ in range(REFINEMENTS):
        agree = _off(before, after, R, t) < gate * sigma
        if agree.sum() < 3:
            break
        R, t = fitted(before[agree], after[agree], sigma[agree])
    return Consensus(R, t, _off(before, after, R, t) < gate * sigma)


def fitted(before: F64, after: F64, sigma: F64) -> tuple[F64, F64]:
    """R (3, 3) and t (3,) of least squares, each pair weighed by 1/sigma² (Umeyama, PAMI 1991)."""
    w = 1.0 / sigma**2
    a, b = w @ before / w.sum(), w @ after / w.sum()
    R = nearest_rotation((after - b).T @ ((before - a) * w[:, None]))
    return R, b - R @ a


def fit_covariance(places: F64, sigma: F64) -> F64:
    """(6, 6) of xi = (rho, phi) in `p <- p + rho + phi × p` of a fit to places (n, 3) known to sigma (n,)."""
    w = 1.0 / sigma**2
    x, y, z = places.T
    o = np.zeros_like(x)
    J = np.stack([np.stack([o + 1, o, o, o, z, -y], -1), np.stack([o, o + 1, o, -z, o, x], -1), np.stack([o, o, o + 1, y, -x, o], -1)], 1)
    H = np.einsum("n,nij,nik->jk", w, J, J)
    return np.linalg.inv(H + 1e-6 * np.eye(6))


def _off(before: F64, after: F64, R: F64, t: F64) -> F64:
    return np.asarray(np.linalg.norm(before @ R.T + t - after, axis=1))
