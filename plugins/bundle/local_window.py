"""Bundle adjustment of the newest keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.linalg import inv_symmetric, matmul
from trihedron.pipeline.core.linalg_kernels import solve_positive
from trihedron.pipeline.core.options import PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Correction, Map
from trihedron.plugins.bundle.local_window_kernels import (
    HUBER,
    SQUARES,
    TRUNCATED,
    NormalEquations,
    back_substitute,
    landmark_covariances,
    linearise_bundle,
    reduce_system,
    retract,
)
from trihedron.plugins.bundle.window import BundleMeasurements, BundleOptions, BundleState, BundleWindow, bundle_problem, bundle_window, free_poses
from trihedron.plugins.mapping.covisibility_graph import newest_keyframes
from trihedron.plugins.mapping.landmarks import ENDPOINTS, POSITION

DAMPING, MIN_DAMPING = 1e-4, 1e-9
CONVERGED = 1e-2  # squared Mahalanobis norm of the step of poses and planes, on average over these parameters


@register("bundle", "local_window")
@dataclass(frozen=True)
class LocalWindow(BundleOptions):
    """Levenberg–Marquardt over the newest keyframes, their points, lines, planes and the right angles between the planes, once per keyframe.

    Points and lines are eliminated by the Schur complement (Triggs et al., "Bundle Adjustment – A Modern Synthesis", 2000). Every residual is
    weighted by its covariance, with Huber's loss. Keyframes outside the window that observe its landmarks are fixed, and so is the first of all, the
    world. The motion between keyframes that are neighbours in time is a measurement too, by odometry: a window that few landmarks, perhaps
    wrong ones, connect with the map stays where tracking saw it."""

    iterations: PositiveInt = 10

    def __call__(self, map: Map) -> Correction | None:
        """Return the correction, or None when this version of the map has no new keyframe, or none to adjust."""
        newest = newest_keyframes(map, 1)
        if not len(newest) or map.keyframes.rows("index", newest)[0] != map.index:
            return None
        window = bundle_window(self, map)
        if not len(window.free):
            return None
        return bundle_correction(map, window, solve_bundle(*bundle_problem(self, map, window), self.iterations))


@dataclass(frozen=True)
class BundleSolution:
    """The adjusted state with its cost under the last loss and the steps tried. Covariances are marginal, given the fixed keyframes: (6 free + 3 p,
    ...) of poses (xi) and planes (a, b, d), and (n + m, 4, 4) of points (the first three) and of lines in `line_basis` at both ends."""

    state: BundleState
    cost: float
    iterations: int
    covariance: F64
    landmark_covariance: F64


def solve_bundle(state: BundleState, seen: BundleMeasurements, iterations: int) -> BundleSolution:
    """Minimise the sum of all terms from `state`, with Huber's loss and then without the outliers, in at most `iterations` steps each.

    Never raises: parameters without observations stay where they are, and the cost never grows."""
    losses = (HUBER, TRUNCATED) if seen.robust else (SQUARES,)
    now, trial = _buffers(state, seen), _buffers(state, seen)
    S, y, inverses = np.empty(now.H.shape), np.empty(len(now.g)), np.empty_like(now.V)
    used, cost = 0, 0.0
    for loss in losses:
        state, cost, steps, now, trial = _minimise(state, seen, loss, iterations, now, trial, loss == losses[-1])
        used += steps
    reduce_system(now, seen, 0.0, S, y, inverses)
    covariance = inv_symmetric(S)
    landmarks = np.empty_like(now.V)
    landmark_covariances(now, seen, inverses, covariance, landmarks)
    return BundleSolution(state, cost, used, covariance, landmarks)


def _minimise(
    state: BundleState, seen: BundleMeasurements, loss: int, iterations: int, now: NormalEquations, trial: NormalEquations, last: bool
) -> tuple[BundleState, float, int, NormalEquations, NormalEquations]:
    """Run Levenberg–Marquardt under one loss. Returns the state, its cost, the steps tried, and the buffers of the normal equations.

    After the `last` loss the first buffer holds the equations at the returned state; before it they are not needed any more."""
    cost = linearise_bundle(state, seen, loss, now, True)
    S, y, inverses = np.empty(now.H.shape), np.empty(len(now.g)), np.empty_like(now.V)
    dx, steps, damping = np.empty(len(now.g)), np.empty((len(now.V), 4)), DAMPING
    for used in range(iterations):
        reduce_system(now, seen, damping, S, y, inverses)
        if not solve_positive(S, y, dx):
            damping *= 10.0
            continue
        back_substitute(now, seen, inverses, dx, steps)
        trial_state = retract(state, seen.free, dx, steps)
        length = float(matmul(dx, S, dx)) / max(len(dx), 1)
        new = linearise_bundle(trial_state, seen, loss, trial, last or not length < CONVERGED)
        if new < cost:
            state, cost, damping = trial_state, new, max(0.1 * damping, MIN_DAMPING)
            now, trial = trial, now
        else:
            damping *= 10.0
        if length < CONVERGED:
            return state, float(cost), used + 1, now, trial
    return state, float(cost), iterations, now, trial


def _buffers(state: BundleState, seen: BundleMeasurements) -> NormalEquations:
    """Buffers for the normal equations."""
    dense, landmarks = 6 * seen.free + 3 * len(state.planes), len(state.points) + len(state.lines)
    observations = len(seen.point_keyframes) + len(seen.line_keyframes)
    return NormalEquations(
        np.empty((dense, dense)), np.empty(dense), np.empty((landmarks, 4, 4)), np.empty((landmarks, 4)), np.empty((observations, 6, 4))
    )


def bundle_correction(map: Map, window: BundleWindow, found: BundleSolution) -> Correction:
    """The window's keyframes and landmarks with their marginal information, pose uncertainty included, as a correction of the map.

    Later observations are fused on top of it; the next adjustment starts again from the observations themselves."""
    state, free, n = found.state, len(window.free), len(window.points)
    points, ends = found.landmark_covariance[:n, :3, :3], _ends(map, window, state.lines, found.landmark_covariance[n:])
    planes = [found.covariance[i : i + 3, i : i + 3] for i in range(6 * free, len(found.covariance), 3)]
    return Correction(
        index=map.index,
        stamp_ns=map.stamp_ns,
        based_on=map.revision,
        keyframe_ids=window.free,
        T_world_keyframe=free_poses(state, free),
        point_ids=window.points,
        points_m=POSITION.rounded(state.points),
        point_information=_symmetrise(inv_symmetric(points)).astype(np.float32),
        line_ids=window.lines,
        endpoints_m=ENDPOINTS.rounded(state.lines),
        line_information=_symmetrise(inv_symmetric(ends)).astype(np.float32),
        plane_ids=window.planes,
        coefficients=state.planes,
        plane_covariance=_symmetrise(np.array(planes, np.float64).reshape(-1, 3, 3)),
    )


def _ends(map: Map, window: BundleWindow, lines: F64, covariance: F64) -> F64:
    """Covariance (m, 2, 3, 3) of the ends of lines (m, 2, 3): that found across them, (m, 4, 4), and along them the map's previous one, since the
    position of a line was adjusted, not its extent."""
    direction = lines[:, 1] - lines[:, 0]
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    known = inv_symmetric(map.lines.rows("information", window.lines))
    along = np.einsum("mi,meij,mj->me", direction, known, direction)
    N = tangent_basis(direction)
    across = np.stack([covariance[:, :2, :2], covariance[:, 2:, 2:]], axis=1)
    outer: F64 = direction[:, :, None] * direction[:, None, :]
    return np.asarray(matmul(N[:, None], across, np.swapaxes(N, -1, -2)[:, None]) + along[..., None, None] * outer[:, None])


def _symmetrise(matrices: F64) -> F64:
    return 0.5 * (matrices + np.swapaxes(matrices, -1, -2))
