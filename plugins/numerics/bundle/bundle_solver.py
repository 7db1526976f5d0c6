"""Bundle adjustment by Levenberg–Marquardt: keyframes, points, lines and planes at once, points and lines eliminated by the Schur complement.

Triggs et al., "Bundle Adjustment – A Modern Synthesis", 2000. Planes stay with the poses in the reduced system: they are few, and the parallel and
perpendicular ones are tied to each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64
from trihedron.plugins.numerics.algebra.small_linear import solve_positive
from trihedron.plugins.numerics.algebra.uncertainty import inverse
from trihedron.plugins.numerics.bundle.bundle_kernel import HUBER, SQUARES, TRUNCATED, NormalEquations, linearise_bundle
from trihedron.plugins.numerics.bundle.bundle_problem import BundleMeasurements, BundleState
from trihedron.plugins.numerics.bundle.bundle_step import landmark_steps, marginals, moved_bundle, reduce_bundle

DAMPING, MIN_DAMPING = 1e-4, 1e-9
CONVERGED = 1e-2  # squared length of a pose's or plane's step in standard deviations, on average over the unknowns


@dataclass(frozen=True)
class BundleSolution:
    """The state found, with its cost under the last loss. Covariances are marginal, given the held keyframes: (6 free + 3
    p, ...) of poses (xi) and planes (a, b, d), and (n + m, 4, 4) of points (the first three) and of lines in `line_basis` at both ends."""

    state: BundleState
    cost: float
    iterations: int
    covariance: F64
    landmark_covariance: F64


def solve_bundle(state: BundleState, seen: BundleMeasurements, iterations: int) -> BundleSolution:
    """Minimise the sum of all terms from `state`, with Huber's cost and then without the outliers, in at most so many steps each. Never raises: what
    nothing measures keeps its place, and the cost never grows."""
    losses = (HUBER, TRUNCATED) if seen.robust else (SQUARES,)
    now, trial = _empty(state, seen), _empty(state, seen)
    S, y, inverses = np.empty(now.H.shape), np.empty(len(now.g)), np.empty_like(now.V)
    used, cost = 0, 0.0
    for loss in losses:
        state, cost, steps, now, trial = _minimised(state, seen, loss, iterations, now, trial, loss == losses[-1])
        used += steps
    reduce_bundle(now, seen, 0.0, S, y, inverses)
    covariance = inverse(S)
    landmarks = np.empty_like(now.V)
    marginals(now, seen, inverses, covariance, landmarks)
    return BundleSolution(state, cost, used, covariance, landmarks)


def _minimised(
    state: BundleState, seen: BundleMeasurements, loss: int, iterations: int, now: NormalEquations, trial: NormalEquations, last: bool
) -> tuple[BundleState, float, int, NormalEquations, NormalEquations]:
    """Levenberg–Marquardt under one loss. Returns the state, its cost, the steps tried and the room for the normal equations, after the `last` loss
    those at the state first; before it they are not needed any more."""
    cost = linearise_bundle(state, seen, loss, now, True)
    S, y, inverses = np.empty(now.H.shape), np.empty(len(now.g)), np.empty_like(now.V)
    dx, steps, damping = np.empty(len(now.g)), np.empty((len(now.V), 4)), DAMPING
    for used in range(iterations):
        reduce_bundle(now, seen, damping, S, y, inverses)
        if not solve_positive(S, y, dx):
            damping *= 10.0
            continue
        landmark_steps(now, seen, inverses, dx, steps)
        moved = moved_bundle(state, seen.free, dx, steps)
        length = float(dx @ S @ dx) / max(len(dx), 1)
        new = linearise_bundle(moved, seen, loss, trial, last or not length < CONVERGED)
        if new < cost:
            state, cost, damping = moved, new, max(0.1 * damping, MIN_DAMPING)
            now, trial = trial, now
        else:
            damping *= 10.0
        if length < CONVERGED:
            return state, float(cost), used + 1, now, trial
    return state, float(cost), iterations, now, trial


def _empty(state: BundleState, seen: BundleMeasurements) -> NormalEquations:
    """Room for the normal equations."""
    dense, landmarks = 6 * seen.free + 3 * len(state.planes), len(state.points) + len(state.lines)
    observations = len(seen.point_keyframes) + len(seen.line_keyframes)
    return NormalEquations(
        np.empty((dense, dense)), np.empty(dense), np.empty((landmarks, 4, 4)), np.empty((landmarks, 4)), np.empty((observations, 6, 4))
    )
