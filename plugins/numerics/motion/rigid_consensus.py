"""The rigid motion that most pairs of places agree on (Fischler and Bolles, CACM 1981), from three pairs at a time."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.geometry import nearest_rotation
from trihedron.pipeline.core.types import F64, I32, Bool

LEAST_M = 0.05  # between the three places of a sample
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
    R, t = _best(before, after, gate * sigma, samples)
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _frame(a: F64, b: F64, c: F64, out: F64) -> bool:
    """Axes (columns) that three places span; False when they are too near to each other or to a line."""
    u, v = b - a, c - a
    n = np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
    length, size = np.sqrt((u * u).sum()), np.sqrt((n * n).sum())
    if length < LEAST_M or size < LEAST_M * length:
        return False
    u, n = u / length, n / size
    out[:, 0], out[:, 1] = u, n
    out[0, 2], out[1, 2], out[2, 2] = u[1] * n[2] - u[2] * n[1], u[2] * n[0] - u[0] * n[2], u[0] * n[1] - u[1] * n[0]
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _best(before: F64, after: F64, reach: F64, samples: I32) -> tuple[F64, F64]:
    best, R_best, t_best = -1, np.eye(3), np.zeros(3)
    A, B, R, t = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for s in range(len(samples)):
        i, j, k = samples[s]
        if not (_frame(before[i], before[j], before[k], A) and _frame(after[i], after[j], after[k], B)):
            continue
        for r in range(3):
            for c in range(3):
                R[r, c] = B[r, 0] * A[c, 0] + B[r, 1] * A[c, 1] + B[r, 2] * A[c, 2]
        for r in range(3):
            t[r] = 0.0
            for m in (i, j, k):
                t[r] += (after[m, r] - R[r, 0] * before[m, 0] - R[r, 1] * before[m, 1] - R[r, 2] * before[m, 2]) / 3.0
        count = 0
        for m in range(len(before)):
            total = 0.0
            for r in range(3):
                e = R[r, 0] * before[m, 0] + R[r, 1] * before[m, 1] + R[r, 2] * before[m, 2] + t[r] - after[m, r]
                total += e * e
            count += total < reach[m] * reach[m]
        if count > best:
            best, R_best, t_best = count, R.copy(), t.copy()
    return R_best, t_best
