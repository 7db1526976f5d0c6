"""The motion between two images by all their pixels, coarse to fine; see `dense_rows` for the residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.core.geometry import exp_so3, nearest_rotation
from trihedron.pipeline.core.types import F64
from trihedron.plugins.numerics.motion.dense_rows import Rows, Source, Target, fill_rows, normal_equations, rows_for, what_is_seen

FREEDOM = 5.0  # degrees of freedom of the t-distribution (Kerl et al.)
SCALE_ROUNDS = 4
HUBER = 1.345
CONVERGED = 1e-9  # squared step, m² and rad²
LEAST_SPREAD = 0.01  # mean square of the normals along a direction, 6° from across it, below which surfaces do not measure it
ALIKE = 100.0  # pixels beside each other err alike: so many count as one
LIMIT_M = 0.01  # brightness must tell a direction as well as this, where surfaces do not

Weights = Callable[[Rows, Source], F64]


@dataclass(frozen=True)
class Gates:
    """What a point must meet to be seen, see `fill_rows`."""

    least_gradient: float
    farthest_m: float
    least_cosine: float


@dataclass(frozen=True)
class Alignment:
    """`p_target = R p_source + t`, the covariance (6, 6) of xi in the target's frame, unit vectors (u, 3) along which the translation was held, and
    the share of the source's points that were seen and agree."""

    R: F64
    t: F64
    covariance: F64
    unobservable: F64
    pixels: int
    share: float


def align(levels: Sequence[tuple[Source, Target, int]], R: F64, t: F64, gates: Gates, weights: Weights, prior: F64) -> Alignment:
    """Gauss–Newton from (R, t) over pairs with a number of iterations, the coarsest first. `prior` (6,) is the information about no motion since the
    start; where neither surfaces nor brightness measure a direction the translation stays as it was."""
    start, R, t = t.copy(), R.copy(), t.copy()
    for source, target, iterations in levels:
        rows = rows_for(source)
        for _ in range(iterations):
            H, g, held, seen = _linearised(rows, source, target, R, t, gates, weights)
            stiff = np.diag(prior)
            stiff[:3, :3] += held.T @ held * max(float(np.trace(H)), 1.0) * 1e3
            moved = np.concatenate([t - start, np.zeros(3)])
            step = np.linalg.solve(H + stiff, -g - stiff @ moved)
            turn = exp_so3(step[3:])
            R, t = turn @ R, turn @ t + step[:3]
            if step @ step < CONVERGED:
                break
    H, g, held, seen = _linearised(rows, source, target, R, t, gates, weights)
    W = weights(rows, source)
    agreeing = float(np.count_nonzero((rows.cosine > 0.0) & (_normalised(rows, W) < 9.0))) / max(len(W), 1)
    covariance = np.linalg.inv(H / ALIKE + np.diag(np.maximum(prior, 1.0)))
    return Alignment(nearest_rotation(R), t, covariance, held, seen, agreeing)


def _linearised(
    rows: Rows, source: Source, target: Target, R: F64, t: F64, gates: Gates, weights: Weights
) -> tuple[F64, F64, F64, int]:  # fmt: skip
    """H, g, the unit vectors (u, 3) along which nothing is measured, and how many points are seen."""
    fill_rows(source, target, R, t, gates.least_gradient, gates.farthest_m, gates.least_cosine, rows)
    W = weights(rows, source)
    H, g = normal_equations(rows, W)
    spread, texture, seen = what_is_seen(rows, W)
    values, vectors = np.linalg.eigh(spread / LEAST_SPREAD + texture * LIMIT_M**2 / ALIKE)
    return H, g, np.ascontiguousarray(vectors[:, values < 1.0].T), seen


def _normalised(rows: Rows, W: F64) -> F64:
    """(n,) squared residuals in standard deviations, robust weights included."""
    r = rows.r
    return np.asarray(W[:, 0] * r[:, 0] ** 2 + 2.0 * W[:, 1] * r[:, 0] * r[:, 1] + W[:, 2] * r[:, 1] ** 2)


def student_weights(rows: Rows, source: Source) -> F64:
    """(n, 3): the t-distribution of brightness and depth together, its 2 × 2 scale estimated from the residuals (Kerl, Sturm, Cremers, IROS 2013);
    depth in units of the sensor's noise, since that grows with the square of it."""
    return np.asarray(_student(rows.r, rows.cosine, source.sigma_m))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _student(r: F64, cosine: F64, sigma: F64) -> F64:
    n = len(r)
    a, b, c = 1.0 / 25.0, 0.0, 1.0  # the inverse of the scale: of brightness and depth in σ
    for _ in range(SCALE_ROUNDS):
        saa, sab, sbb, count = 0.0, 0.0, 0.0, 0
        for i in range(n):
            if cosine[i] > 0.0:
                e0, e1 = r[i, 0], r[i, 1] / (cosine[i] * sigma[i])
                w = (FREEDOM + 2.0) / (FREEDOM + a * e0 * e0 + 2.0 * b * e0 * e1 + c * e1 * e1)
                saa, sab, sbb, count = saa + w * e0 * e0, sab + w * e0 * e1, sbb + w * e1 * e1, count + 1
        if count < 10:
            break
        saa, sab, sbb = saa / count + 0.25, sab / count, sbb / count + 0.01
        det = saa * sbb - sab * sab
        a, b, c = sbb / det, -sab / det, saa / det
    W = np.zeros((n, 3))
    for i in range(n):
        if cosine[i] > 0.0:
            s = 1.0 / (cosine[i] * sigma[i])
            e0, e1 = r[i, 0], r[i, 1] * s
            w = (FREEDOM + 2.0) / (FREEDOM + a * e0 * e0 + 2.0 * b * e0 * e1 + c * e1 * e1)
            W[i, 0], W[i, 1], W[i, 2] = w * a, w * b * s, w * c * s * s
    return W


def huber_weights(photometric: float, floor_m: float) -> Weights:
    """Point-to-plane distances in units of the sensor's noise and `floor_m`, brightness in units of its median residual; both with Huber's weights,
    brightness counting `photometric` times as much."""
    return lambda rows, source: np.asarray(_huber(rows.r, rows.cosine, source.sigma_m, photometric, floor_m))


def _huber(r: F64, cosine: F64, sigma: F64, photometric: float, floor_m: float) -> F64:
    W, seen = np.zeros((len(r), 3)), cosine > 0.0
    if not seen.any():
        return W
    off = np.abs(r[seen])
    scale = np.array([max(1.4826 * float(np.median(off[:, 0])), 1.0)]), np.hypot(sigma[seen] * cosine[seen], floor_m)
    for k, column, share in ((0, 0, photometric), (1, 2, 1.0)):
        e = off[:, k] / scale[k]
        W[seen, column] = share * np.minimum(1.0, HUBER / np.maximum(e, 1e-9)) / scale[k] ** 2
    return W
