"""Dense alignment by the residuals of one image's pixels warped into another: brightness, and distance from the surface there.

A point p of the source, moved to `p' = R p + t`, projects to pixel (u, v) of the target. Its brightness residual is `I(u, v) - I_source`; its
geometric residual `k (Z(u, v) - p'_z)` with `k = n·ray`: how far it is from the target's tangent plane, of normal n, at that pixel. So the depth
residual of direct methods (Kerl, Sturm, Cremers, IROS 2013) and the point-to-plane error of projective ICP (Newcombe et al., ISMAR 2011) are one up
to k. Jacobians are with respect to `xi = (rho, phi)` in `p' <- p' + rho + phi × p'`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import nearest_rotation
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.linalg import eigh, inv, matmul, solve
from trihedron.pipeline.core.types import F32, F64
from trihedron.plugins.pose.dense_alignment_kernels import Residuals, Source, Target, fill_residuals, normal_equations, observability
from trihedron.plugins.shared.image_reduction import Level
from trihedron.plugins.shared.image_reduction_kernels import depth_normals, gradients

CONVERGED = 1e-9  # squared step, m² and rad²
LEAST_SPREAD = 0.01  # mean square of the normals along a direction, 6° from across it, below which surfaces do not observe it
CORRELATED = 100.0  # neighbouring pixels have correlated errors: so many count as one
LIMIT_M = 0.01  # σ by brightness below which a direction is observable, where surfaces do not observe it
Weights = Callable[[Residuals, Source], F64]


class DenseOptions(Protocol):
    """Options of every plugin that aligns images densely."""

    @property
    def least_gradient(self) -> float:
        """Brightness gradient (a pixel) below which brightness is not used."""

    @property
    def farthest_m(self) -> float:
        """Distance from the surface beyond which a point is not seen."""

    @property
    def least_cosine(self) -> float:
        """Cosine between the normals of a point and of the surface below which the point is not seen; -1 where normals are not compared."""

    @property
    def motion_sigma_m(self) -> float:
        """Standard deviation of no motion, per frame."""

    @property
    def motion_sigma_deg(self) -> float:
        """Standard deviation of no rotation, per frame."""


@dataclass(frozen=True)
class Alignment:
    """`p_target = R p_source + t`, the covariance (6, 6) of xi in the target's frame, unit vectors (u, 3) along which the translation was held, and
    the share of the source's points that are inliers."""

    R: F64
    t: F64
    covariance: F64
    unobservable: F64
    pixels: int
    share: float


def align(options: DenseOptions, levels: Sequence[tuple[Source, Target, int]], R: F64, t: F64, weights: Weights, gap: int) -> Alignment:
    """Gauss–Newton from (R, t) over pairs of images with a number of iterations each, coarse to fine.

    A weak prior is no motion since the start, `gap` frames ago; where neither surfaces nor brightness observe a direction the translation is held."""
    prior = np.repeat([(options.motion_sigma_m * gap) ** -2, (np.radians(options.motion_sigma_deg) * gap) ** -2], 3)
    start, R, t = t.copy(), R.copy(), t.copy()
    for source, target, iterations in levels:
        residuals = residual_buffers(source)
        for _ in range(iterations):
            H, g, held, seen = _linearise(options, residuals, source, target, R, t, weights)
            information = np.diag(prior)
            information[:3, :3] += matmul(held.T, held) * max(float(np.trace(H)), 1.0) * 1e3
            moved = np.concatenate([t - start, np.zeros(3)])
            step = solve(H + information, -g - matmul(information, moved))
            dR = exp_so3(step[3:])
            R, t = matmul(dR, R), matmul(dR, t) + step[:3]
            if matmul(step, step) < CONVERGED:
                break
    H, g, held, seen = _linearise(options, residuals, source, target, R, t, weights)
    W = weights(residuals, source)
    agreeing = float(np.count_nonzero((residuals.cosine > 0.0) & (_mahalanobis2(residuals, W) < 9.0))) / max(len(W), 1)
    covariance = inv(H / CORRELATED + np.diag(np.maximum(prior, 1.0)))
    return Alignment(nearest_rotation(R), t, covariance, held, seen, agreeing)


def _linearise(
    options: DenseOptions, residuals: Residuals, source: Source, target: Target, R: F64, t: F64, weights: Weights
) -> tuple[F64, F64, F64, int]:  # fmt: skip
    """Linearise at R, t: H, g, the unobservable unit vectors (u, 3), and the number of points seen."""
    fill_residuals(source, target, R, t, options.least_gradient, options.farthest_m, options.least_cosine, residuals)
    W = weights(residuals, source)
    H, g = normal_equations(residuals, W)
    spread, texture, seen = observability(residuals, W)
    values, vectors = eigh(spread / LEAST_SPREAD + texture * LIMIT_M**2 / CORRELATED)
    return H, g, np.ascontiguousarray(vectors[:, values < 1.0].T), seen


def _mahalanobis2(residuals: Residuals, W: F64) -> F64:
    """Squared Mahalanobis norms (n,) of the residuals, robust weights included."""
    r = residuals.r
    return np.asarray(W[:, 0] * r[:, 0] ** 2 + 2.0 * W[:, 1] * r[:, 0] * r[:, 1] + W[:, 2] * r[:, 1] ** 2)


def source_of(level: Level, noise: NDArray[np.float64], stride: int, normals: F32) -> Source:
    """Sample every `stride`-th pixel that has depth; `noise` is the standard deviation of a depth by centimetres."""
    z = level.depth_m[::stride, ::stride]
    r, c = np.nonzero(z > 0.0)
    z = z[r, c].astype(np.float64)
    fx, fy, cx, cy = level.intrinsics
    points = np.stack([(c * stride - cx) / fx * z, (r * stride - cy) / fy * z, z], axis=1)
    sigma = noise[np.minimum((100.0 * z).astype(int), len(noise) - 1)]
    at = r * stride, c * stride
    return Source(points, np.ascontiguousarray(normals[at]), level.gray[at].astype(np.float64), sigma)


def target_of(level: Level, reach: int, normals: F32 | None = None) -> Target:
    """Attach gradients and, where they are not given, normals over `reach` pixels to an image."""
    x, y = gradients(level.gray)
    return Target(
        level.gray, x, y, level.depth_m, depth_normals(level.depth_m, level.intrinsics, reach) if normals is None else normals, level.intrinsics
    )


def residual_buffers(source: Source) -> Residuals:
    """Buffers for the residuals of a source."""
    n = len(source.points_m)
    return Residuals(np.zeros((n, 2)), np.zeros((n, 2, 6)), np.zeros(n), np.zeros((n, 3)))
