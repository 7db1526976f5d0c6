"""Steps of bundle adjustment: the Schur complement of points and lines, their way back, and what the solution leaves uncertain. For numba."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.algebra.small_linear import invert_symmetric
from trihedron.plugins.numerics.bundle.bundle_kernel import NormalEquations, line_basis
from trihedron.plugins.numerics.bundle.bundle_problem import BundleMeasurements, BundleState
from trihedron.plugins.numerics.motion.pose_step import move
from trihedron.plugins.numerics.motion.pose_terms import basis

# Trust: a step is a little dearer than the data say, so that what no observation sees stays where it is. Per unknown, 1/m² and 1/rad².
TRUST_M, TRUST_RAD, TRUST_LANDMARK = 1.0 / 0.1**2, 1.0 / np.radians(2.0) ** 2, 1.0 / 0.5**2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _invert_block(V: F64, damping: float, point: bool, A: F64) -> None:
    """A (4, 4): inverse of the damped block V (lower triangle) with the trust added; that of a line, which is positive definite, by Gauss and Jordan
    without pivots."""
    for i in range(4):
        for j in range(i + 1):
            A[i, j] = A[j, i] = V[i, j]
        A[i, i] += damping * V[i, i] + TRUST_LANDMARK
    if point:
        invert_symmetric(A, A)
        A[3, 3] = 1.0 / A[3, 3]
        return
    for k in range(4):
        pivot = 1.0 / A[k, k]
        A[k, k] = 1.0
        for j in range(4):
            A[k, j] *= pivot
        for i in range(4):
            if i != k:
                factor = A[i, k]
                A[i, k] = 0.0
                for j in range(4):
                    A[i, j] -= factor * A[k, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def trusted(H: F64, free: int, damping: float, S: F64) -> None:
    """S (c, c), full: the damped H with the trust added."""
    for i in range(len(H)):
        for j in range(i + 1):
            S[i, j] = S[j, i] = H[i, j]
    for i in range(len(H)):
        of_angle = i % 6 >= 3 if i < 6 * free else (i - 6 * free) % 3 < 2
        S[i, i] += damping * H[i, i] + (TRUST_RAD if of_angle else TRUST_M)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _eliminate(A: F64, b: F64, W: F64, point: bool, keyframes: I32, begin: int, end: int, free: int, Y: F64, S: F64, y: F64) -> None:
    """Subtract one landmark, whose inverse block is A and whose observations are begin to end, from the lower triangle of the reduced system. Of a
    `point` the fourth unknown is left out. Y (6, 4): room."""
    for o in range(begin, end):
        k = keyframes[o]
        if k >= free:
            continue
        for i in range(6):
            w0, w1, w2, w3 = W[o, i, 0], W[o, i, 1], W[o, i, 2], W[o, i, 3]
            for j in range(3 if point else 4):
                share = w0 * A[0, j] + w1 * A[1, j] + w2 * A[2, j]
                Y[i, j] = share if point else share + w3 * A[3, j]
            share = Y[i, 0] * b[0] + Y[i, 1] * b[1] + Y[i, 2] * b[2]
            y[6 * k + i] += share if point else share + Y[i, 3] * b[3]
        for other in range(begin, end):
            q = keyframes[other]
            if q > k or q >= free:
                continue
            for i in range(6):
                y0, y1, y2, y3 = Y[i, 0], Y[i, 1], Y[i, 2], Y[i, 3]
                for j in range(i + 1 if other == o else 6):
                    share = y0 * W[other, j, 0] + y1 * W[other, j, 1] + y2 * W[other, j, 2]
                    S[6 * k + i, 6 * q + j] -= share if point else share + y3 * W[other, j, 3]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def reduce_bundle(normal: NormalEquations, seen: BundleMeasurements, damping: float, S: F64, y: F64, inverses: F64) -> None:
    """The reduced system `S dx = y` of poses and planes (S full) and the inverse blocks of points and lines (l, 4, 4). What a point that was measured
    once says of the pose, and takes back when it is eliminated, is in neither."""
    trusted(normal.H, seen.free, damping, S)
    for i in range(len(y)):
        y[i] = -normal.g[i]
    n, first, Y = len(seen.point_starts) - 1, len(seen.point_keyframes), np.zeros((6, 4))
    for i in range(len(inverses)):
        _invert_block(normal.V[i], damping, i < n, inverses[i])
        if i < n:
            begin, end = seen.point_starts[i], seen.point_starts[i + 1]
            if end - begin > 1:
                _eliminate(inverses[i], normal.b[i], normal.W, True, seen.point_keyframes, begin, end, seen.free, Y, S, y)
        else:
            begin, end = seen.line_starts[i - n], seen.line_starts[i - n + 1]
            _eliminate(inverses[i], normal.b[i], normal.W[first:], False, seen.line_keyframes, begin, end, seen.free, Y, S, y)
    for i in range(len(S)):
        for j in range(i):
            S[j, i] = S[i, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def landmark_steps(normal: NormalEquations, seen: BundleMeasurements, inverses: F64, dx: F64, steps: F64) -> None:
    """steps (l, 4) of points and lines that go with the step dx of poses and planes."""
    n, first = len(seen.point_starts) - 1, len(seen.point_keyframes)
    rest = np.empty(4)
    for i in range(len(steps)):
        for j in range(4):
            rest[j] = normal.b[i, j]
        begin, end = (seen.point_starts[i], seen.point_starts[i + 1]) if i < n else (seen.line_starts[i - n], seen.line_starts[i - n + 1])
        for o in range(begin, end):
            k = seen.point_keyframes[o] if i < n else seen.line_keyframes[o]
            if k < seen.free:
                block = normal.W[o] if i < n else normal.W[first + o]
                for j in range(4):
                    for a in range(6):
                        rest[j] += block[a, j] * dx[6 * k + a]
        for j in range(4):
            steps[i, j] = 0.0
            for a in range(4):
                steps[i, j] -= inverses[i, j, a] * rest[a]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def moved_bundle(state: BundleState, free: int, dx: F64, steps: F64) -> BundleState:
    """The state after the steps of poses and planes, and of points and lines."""
    out = BundleState(state.rotations.copy(), state.positions.copy(), state.points.copy(), state.lines.copy(), state.planes.copy())
    for k in range(free):
        move(state.rotations[k], state.positions[k], dx[6 * k : 6 * k + 6], out.rotations[k], out.positions[k])
    n, N = len(out.points), np.empty((3, 2))
    for i in range(n):
        for j in range(3):
            out.points[i, j] += steps[i, j]
    for i in range(len(out.lines)):
        line_basis(state.lines[i], N)
        for end in range(2):
            for j in range(3):
                out.lines[i, end, j] += N[j, 0] * steps[n + i, 2 * end] + N[j, 1] * steps[n + i, 2 * end + 1]
    for i in range(len(out.planes)):
        at = 6 * free + 3 * i
        basis(state.planes[i], N)
        size = 0.0
        for j in range(3):
            out.planes[i, j] += N[j, 0] * dx[at] + N[j, 1] * dx[at + 1]
            size += out.planes[i, j] ** 2
        for j in range(3):
            out.planes[i, j] /= np.sqrt(size)
        out.planes[i, 3] += dx[at + 2]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def marginals(normal: NormalEquations, seen: BundleMeasurements, inverses: F64, covariance: F64, out: F64) -> None:
    """out (l, 4, 4): covariance of each point and line with that of the poses, (c, c), in it: `A + A Wᵀ Σ W A`, A being its inverse block."""
    n, first = len(seen.point_starts) - 1, len(seen.point_keyframes)
    M, Q = np.empty((4, 4)), np.zeros((4, 4))
    for i in range(len(out)):
        M[:] = 0.0
        if i < n:
            _between(normal.W, True, seen.point_keyframes, seen.point_starts[i], seen.point_starts[i + 1], seen.free, covariance, M)
        else:
            _between(normal.W[first:], False, seen.line_keyframes, seen.line_starts[i - n], seen.line_starts[i - n + 1], seen.free, covariance, M)
        size = 3 if i < n else 4
        for a in range(size):
            for j in range(size):
                Q[a, j] = M[a, 0] * inverses[i, 0, j] + M[a, 1] * inverses[i, 1, j] + M[a, 2] * inverses[i, 2, j] + M[a, 3] * inverses[i, 3, j]
        for a in range(4):
            b0, b1, b2, b3 = inverses[i, a, 0], inverses[i, a, 1], inverses[i, a, 2], inverses[i, a, 3]
            for j in range(4):
                out[i, a, j] = inverses[i, a, j]
            for j in range(size):
                out[i, a, j] = out[i, a, j] + b0 * Q[0, j] + b1 * Q[1, j] + b2 * Q[2, j] + b3 * Q[3, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _between(W: F64, point: bool, keyframes: I32, begin: int, end: int, free: int, covariance: F64, M: F64) -> None:
    """Add `Wᵀ Σ W` of one landmark to M (4, 4), row by row of Σ W; of a `point` the fourth row and column are left out."""
    for o in range(begin, end):
        k = keyframes[o]
        if k >= free:
            continue
        for a in range(6):
            p0, p1, p2, p3 = 0.0, 0.0, 0.0, 0.0
            for other in range(begin, end):
                q = keyframes[other]
                if q < free:
                    for b in range(6):
                        known = covariance[6 * k + a, 6 * q + b]
                        p0 += known * W[other, b, 0]
                        p1 += known * W[other, b, 1]
                        p2 += known * W[other, b, 2]
                        if not point:
                            p3 += known * W[other, b, 3]
            for j in range(3 if point else 4):
                w = W[o, a, j]
                M[j, 0] += w * p0
                M[j, 1] += w * p1
                M[j, 2] += w * p2
                M[j, 3] += w * p3
