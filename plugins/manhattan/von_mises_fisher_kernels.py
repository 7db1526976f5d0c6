"""Numba kernels of `von_mises_fisher.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import polar_rotation
from trihedron.pipeline.core.types import F64

# Mixture of von Mises–Fisher distributions about the six signed axes of a rotation, over a uniform background.

LEAST, MOST = 5.0, 20000.0  # concentrations: 26° and 0.4° of standard deviation; below, 1/(1 − r) is not the concentration
FAR = -30.0  # exponent of a density that is nothing


class AxisMixture(NamedTuple):
    """Directions x about axes a_k, the columns of R: `p(x) = Σ_k share_k vMF(x; ±a_k, concentration_k) / 2 + share_3 / 4π`, for each population
    (rows: normals, lines) of directions."""

    R: F64  # (3, 3), a rotation unless the axes are free of each other
    concentration: F64  # (2, 3), 1/rad²
    share: F64  # (2, 4), the last of the background
    resultant: F64  # (2, 3, 3) sums of the directions that belong to each axis (columns), by weight
    number: F64  # (2, 3) of directions
    weight: F64  # (2, 3)


@kernel
def em_step(
    mixture: AxisMixture, directions: F64, weights: F64, first_line: int, prior: float, concentration: float, free: bool = False
) -> AxisMixture:
    """One step of expectation–maximisation, antipodes being one.

    Given what belongs to which axis, R in closed form maximises `Σ κ_k r w ±x·a_k` (Straub et al., IROS 2015), κ solves `coth κ − 1/κ = mean
    ±x·a_k`. As a priori knowledge each axis counts `prior` more directions of the given concentration. With `free` axes each of them maximises its
    own sum, at whatever angles to the others."""
    sums = _expectation(directions, weights, first_line, mixture.R, mixture.concentration, mixture.share)
    kappa, share, resultant, M = np.empty((2, 3)), np.empty((2, 4)), np.empty((2, 3, 3)), 1e-6 * mixture.R
    for kind in range(2):
        own = weights[:first_line] if kind == 0 else weights[first_line:]
        total, more = own.sum(), prior * max(own.sum() / max(len(own), 1), 1e-12)
        share[kind, 3] = total + more
        for k in range(3):
            weight, off = sums[kind, k, 1], sums[kind, k, 2]
            kappa[kind, k] = min(max((weight + more) / (off + more / concentration), LEAST), MOST)
            share[kind, k] = weight + more
            share[kind, 3] -= weight
            for j in range(3):
                resultant[kind, j, k] = sums[kind, k, 3 + j]
                M[j, k] += kappa[kind, k] * resultant[kind, j, k]
        share[kind] /= share[kind].sum()
    if free:
        for k in range(3):
            M[:, k] /= np.sqrt((M[:, k] ** 2).sum())
    R = M if free else polar_rotation(M)
    return AxisMixture(R, kappa, share, resultant, sums[:, :, 0].copy(), sums[:, :, 1].copy())


@kernel
def expectation_maximisation(
    mixture: AxisMixture,
    directions: F64,
    weights: F64,
    first_line: int,
    prior: float,
    concentration: float,
    free: bool,
    most: int,
    tolerance: float,
) -> AxisMixture:
    """Take at most `most` steps of EM; the last one turned the axes by less than `tolerance` (rad) and changed no concentration by a hundredth."""
    for _ in range(most):
        before = mixture
        mixture = em_step(before, directions, weights, first_line, prior, concentration, free)
        moved = np.sqrt(0.5 * ((mixture.R - before.R) ** 2).sum())
        if moved < tolerance and np.abs(mixture.concentration / before.concentration - 1.0).max() < 0.01:
            break
    return mixture


@kernel
def _expectation(directions: F64, weights: F64, first_line: int, R: F64, concentration: F64, share: F64) -> F64:
    """(2, 3, 6) per population and axis: number, weight, `Σ w (1 − |x·a|)` and `Σ w ±x` of the directions, each as far as it belongs to the axis."""
    out = np.zeros((2, 3, 6))
    p = np.empty(3)
    dot = np.empty(3)
    for i in range(len(directions)):
        kind = 0 if i < first_line else 1
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        total = share[kind, 3]
        for k in range(3):
            kappa = concentration[kind, k]
            dot[k] = x * R[0, k] + y * R[1, k] + z * R[2, k]
            exponent = kappa * (min(abs(dot[k]), 1.0) - 1.0)
            p[k] = share[kind, k] * kappa * np.exp(exponent) if exponent > FAR else 0.0
            total += p[k]
        for k in range(3):
            r = p[k] / total
            w = r * weights[i]
            out[kind, k, 0] += r
            out[kind, k, 1] += w
            out[kind, k, 2] += w * (1.0 - min(abs(dot[k]), 1.0))
            w = w if dot[k] > 0.0 else -w
            out[kind, k, 3] += w * x
            out[kind, k, 4] += w * y
            out[kind, k, 5] += w * z
    return out
