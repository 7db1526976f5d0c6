"""Camera pose from points, lines and planes whose place in the world is known (eqs. 2–8): robust Levenberg–Marquardt with a Gaussian prior.

Every term is weighed by covariances: of the measurement *and* of the landmark. The prior (the Manhattan rotation, a weak one on the position)
keeps what the data cannot see at its prediction, so that any set of terms, even one plane, can be solved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, U8, Camera
from trihedron.plugins.numerics.algebra.small_linear import inverse_positive, solve_positive
from trihedron.plugins.numerics.motion.pose_kernel import (
    CHI2_2,
    CHI2_3,
    INLIER,
    NO_DEPTH,
    OUTLIER,
    Chi2,
    Flags,
    gate,
    linearise,
)
from trihedron.plugins.numerics.motion.pose_noise import Weights, rows_of, weigh
from trihedron.plugins.numerics.motion.pose_step import add_prior, move, size, step
from trihedron.plugins.numerics.motion.pose_terms import LineTerms, PlaneTerms, PointTerms, rotation_and_translation

ROUNDS, ITERATIONS, ROBUST_ROUNDS = 4, 10, 2  # as ORB-SLAM2 optimises a pose; Huber only in the first rounds
CONVERGED = 1e-3  # squared length of a step in standard deviations below which a round has converged
MAX_DAMPING = 1e10
PLANE_SLACK = 4.0  # when a direction would be lost with the planes beyond their gate, they are outliers only beyond this × it

Terms = tuple[PointTerms, LineTerms, PlaneTerms]
NO_POINTS = PointTerms(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))
NO_LINES = LineTerms(
    np.empty((0, 2, 3)), np.empty((0, 2, 3, 3)), np.empty((0, 2, 2)), np.empty(0), np.empty((0, 2, 3)), np.empty((0, 2, 3, 3))
)  # fmt: skip
NO_PLANES = PlaneTerms(np.empty(0, np.int32), np.empty((0, 4)), np.empty((0, 3, 3)), np.empty((0, 4)), np.empty((0, 3, 3)))


@dataclass(frozen=True)
class PoseSolution:
    """What `solve_pose` found. Covariance and `unobservable` are in xi = (rho, phi), camera frame: (6, 6) and columns of (6, u); with the
    rotation fixed (3, 3) and (3, u) of rho alone. Flags are OUTLIER, INLIER or NO_DEPTH (a line whose image part alone fits)."""

    T_world_camera: F64
    covariance: F64
    unobservable: F64
    points: U8
    lines: U8
    planes: U8
    cost: float


def solve_pose(
    T_world_camera: F64,
    camera: Camera,
    T_prior: F64,
    prior_information: F64,
    points: PointTerms = NO_POINTS,
    lines: LineTerms = NO_LINES,
    planes: PlaneTerms = NO_PLANES,
    fixed_rotation: bool = False,
) -> PoseSolution:
    """Minimise the robust sum of all terms plus the prior, from `T_world_camera` (4, 4), in four rounds with a new choice of outliers after each.

    `prior_information` (6, 6), positive definite, is that of xi in `T = T_prior · (R_prior-frame translation, rotation)`. With `fixed_rotation`
    only the three unknowns of the position are solved (eqs. 2–7). Nothing raises: without terms the prior's mean is returned. A plane
    beyond its gate is kept, with a Huber weight, where nothing else sees a direction: a bare room has few walls, and 5 % is too many to lose."""
    terms = points, lines, planes
    found = _solved(T_world_camera, camera, T_prior, prior_information, terms, fixed_rotation, 1.0)
    if found.unobservable.shape[1] and not found.planes.all():
        return _solved(T_world_camera, camera, T_prior, prior_information, terms, fixed_rotation, PLANE_SLACK)
    return found


def _solved(
    T_world_camera: F64,
    camera: Camera,
    T_prior: F64,
    prior_information: F64,
    terms: Terms,
    fixed_rotation: bool,
    slack: float,
) -> PoseSolution:
    """`solve_pose` with the planes' gates multiplied by `slack`."""
    free, flags = 3 if fixed_rotation else 6, _all_inliers(terms)
    prior = np.array(prior_information, np.float64)
    T, covariance, data, _, cost, complete = _solve(np.array([T_world_camera, T_prior]), prior, camera.intrinsics, *terms, flags, free, ROUNDS, slack)
    unobservable = np.empty((free, 0)) if complete else _unobservable(data, prior[:free, :free])
    return PoseSolution(T, covariance, unobservable, *flags, cost)


def first_step(
    T_world_camera: F64, camera: Camera, T_prior: F64, prior_information: F64, terms: Terms, flags: Flags | None = None
) -> tuple[F64, F64]:
    """Where `solve_pose` would go at first from `T_world_camera`, by the terms not flagged OUTLIER, with Huber's cost: xi (6,), and its
    covariance (6, 6). Changes the flags."""
    poses, flags = np.array([T_world_camera, T_prior]), _all_inliers(terms) if flags is None else flags
    _, covariance, _, xi, _, _ = _solve(poses, np.array(prior_information, np.float64), camera.intrinsics, *terms, flags, 6, 0, 1.0)
    return xi, covariance


def _all_inliers(terms: Terms) -> Flags:
    points, lines, planes = terms
    return Flags(*(np.full(count, INLIER, np.uint8) for count in (len(points.positions_m), len(lines.endpoints_m), len(planes.kinds))))


def classify_terms(
    T_world_camera: F64, camera: Camera, points: PointTerms = NO_POINTS, lines: LineTerms = NO_LINES, planes: PlaneTerms = NO_PLANES
) -> Flags:
    """OUTLIER, INLIER or NO_DEPTH of every term at a given pose."""
    terms = points, lines, planes
    flags = _all_inliers(terms)
    _solve(np.array([T_world_camera, T_world_camera]), np.eye(6), camera.intrinsics, *terms, flags, 6, 0, 1.0)
    return flags


def _unobservable(H_data: F64, H_prior: F64) -> F64:
    """(k, u) unit directions in which the data say less than the prior: generalised eigenvalues of (H_data, H_prior) below 1."""
    half = np.linalg.inv(np.linalg.cholesky(H_prior))
    values, vectors = np.linalg.eigh(half @ H_data @ half.T)
    directions = half.T @ vectors[:, values < 1.0]
    return directions / np.linalg.norm(directions, axis=0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve(
    poses: F64,
    prior: F64,
    camera: F64,
    points: PointTerms,
    lines: LineTerms,
    planes: PlaneTerms,
    flags: Flags,
    free: int,
    rounds: int,
    slack: float,
) -> tuple[F64, F64, F64, F64, float, bool]:
    """The rounds from the first of the poses (2, 4, 4), the other one being the prior's; changes `flags`. Returns the pose, its covariance, the
    data's information, the step (6,) that would be next, the cost, and whether the data say more than the prior in all directions.

    Every evaluation is the one call of `linearise`, and a step too short to matter is taken without another. The last turn takes no step and is only
    the information of the final inliers. In no rounds all terms are judged at the first pose."""
    n, m, p = len(points.positions_m), len(lines.endpoints_m), len(planes.kinds)
    weights = Weights(np.empty((n, 3, 3)), np.empty((m, 2, 2)), np.empty((m, 2, 2)), np.empty((p, 3, 3)))
    chi2 = Chi2(np.empty(n), np.empty(m), np.empty(m), np.empty(p))
    (R, t), (R_new, t_new) = rotation_and_translation(poses[0]), rotation_and_translation(poses[0])
    R_prior, t_prior = rotation_and_translation(poses[1])
    H, g, dx = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    data, data_g, trial_H, trial_g = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    cost = 0.0
    for turn in range(rounds + 1):
        cost, damping = np.inf, 1e-6
        _copy(R, t, R_new, t_new)
        weigh(R, t, camera, points, lines, planes, weights)
        for trial in range(ITERATIONS + 1):
            new = linearise(R_new, t_new, camera, points, lines, planes, weights, flags, turn < ROBUST_ROUNDS, free, trial_H, trial_g, chi2)
            _copy(trial_H, trial_g, data, data_g)
            new += add_prior(R_new, t_new, R_prior, t_prior, prior, trial_H, trial_g)
            accepted = trial == 0 or new <= cost
            if accepted:
                cost = new
                _copy(R_new, t_new, R, t)
                _copy(trial_H, trial_g, H, g)
                damping = max(0.1 * damping, 1e-9)
            else:
                damping = max(10.0 * damping, 1e-3)
            if turn == rounds or damping > MAX_DAMPING:
                break
            step(H, g, damping, free, dx)
            move(R, t, dx, R_new, t_new)
            length = size(H, dx)
            if not length > CONVERGED:
                if accepted and length >= 0.0:
                    _copy(R_new, t_new, R, t)
                break
        if turn < rounds or rounds == 0:
            _classify(points, planes, chi2, flags, slack)
    step(H, g, 0.0, free, dx)
    share = gate_efficiency(_rows(points, planes, flags), free) if rounds else 1.0
    covariance, information, complete = _spread(data, share, prior, free)
    T = np.zeros((4, 4))
    for i in range(3):
        T[i, 3] = t[i]
        for j in range(3):
            T[i, j] = R[i, j]
    T[3, 3] = 1.0
    return T, covariance, information, dx, cost, complete


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _copy(A: F64, a: F64, B: F64, b: F64) -> None:
    """A matrix (n, n) and a vector (n,), of a pose or of normal equations, into others."""
    for i in range(len(a)):
        b[i] = a[i]
        for j in range(len(a)):
            B[i, j] = A[i, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spread(data: F64, share: float, prior: F64, free: int) -> tuple[F64, F64, bool]:
    """Covariance of the `free` unknowns by a share of the data's information (lower triangle) and the prior's; that share of the data's; and
    whether it is the larger one in all directions."""
    information, total, more = np.empty((free, free)), np.empty((free, free)), np.empty((free, free))
    for i in range(free):
        for j in range(i + 1):
            information[i, j] = information[j, i] = share * data[i, j]
            total[i, j], more[i, j] = information[i, j] + prior[i, j], information[i, j] - prior[i, j]
    covariance = inverse_positive(total)
    for i in range(free):
        for j in range(i):
            covariance[i, j] = covariance[j, i] = 0.5 * (covariance[i, j] + covariance[j, i])
    return covariance, information, solve_positive(more, np.zeros(free), np.empty(free))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rows(points: PointTerms, planes: PlaneTerms, flags: Flags) -> int:
    """Number of residuals of the inliers."""
    rows = 0
    for i in range(len(flags.points)):
        if flags.points[i]:
            rows += 3 if np.isfinite(points.depth_m[i]) else 2
    for i in range(len(flags.lines)):
        if flags.lines[i]:
            rows += 4 if flags.lines[i] == INLIER else 2
    for i in range(len(flags.planes)):
        if flags.planes[i]:
            rows += rows_of(planes.kinds[i])
    return rows


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gate_efficiency(rows: int, unknowns: int) -> float:
    """Share of the information that is left when terms are chosen by a hard 95 % gate on their own residuals.

    A mean of samples cut at the gate c varies by 1 / F_{k+2}(c), F_k being the distribution of χ², where counting the F_k(c) kept samples promises
    1 / F_k(c); with few redundant rows the residuals are smaller than the noise and the gate bites less. The tests check the normalised error."""
    if rows <= unknowns:
        return 1.0
    half = 0.5 * CHI2_3 / (1.0 - unknowns / rows)
    tail = math.sqrt(half / math.pi) * math.exp(-half)
    kept = math.erf(math.sqrt(half)) - 2.0 * tail  # F_3, the incomplete gamma function of 3/2; that of 5/2 follows by its recurrence
    return (kept - 4.0 / 3.0 * half * tail) / kept


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _classify(points: PointTerms, planes: PlaneTerms, chi2: Chi2, flags: Flags, slack: float) -> None:
    """Choose the outliers anew: 95 % gates of χ², those of planes multiplied by `slack`."""
    for i in range(len(chi2.points)):
        limit = CHI2_3 if np.isfinite(points.depth_m[i]) else CHI2_2
        flags.points[i] = INLIER if chi2.points[i] <= limit else OUTLIER
    for i in range(len(chi2.lines)):
        flags.lines[i] = OUTLIER
        if chi2.lines[i] <= CHI2_2:
            flags.lines[i] = INLIER if chi2.line_depths[i] <= CHI2_2 else NO_DEPTH
    for i in range(len(chi2.planes)):
        flags.planes[i] = INLIER if chi2.planes[i] <= slack * gate(rows_of(planes.kinds[i])) else OUTLIER
