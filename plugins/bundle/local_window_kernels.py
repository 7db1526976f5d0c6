"""Kernels of `local_window.py`: robust Levenberg–Marquardt with the Schur complement over keyframes, points, lines and planes.

In order: residuals and Jacobians, robust normal equations, damping and prior weights, the Schur complement and back-substitution, retraction, and
marginal covariance.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import add_block, dot, invert_symmetric, matmul, matvec, split_pose, tangent_columns
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.bundle.window import BundleMeasurements, BundleState
from trihedron.plugins.mapping.landmark_kernels import EXTEND
from trihedron.plugins.shared.lie_kernels import log_so3
from trihedron.plugins.shared.pose_optimizer_kernels import BEHIND, CHI2_95, retract_pose
from trihedron.plugins.shared.residuals_kernels import NEAR_M, PARALLEL, SAME, depth_direction, line_depth_residual, line_residual, plane_residual

# Residuals and Jacobians of lines, planes and their relations by the landmark; those by the pose are the pose optimiser's.
#
# A line moves across itself only, by two tangent coordinates at each of its two points (four parameters, as a line has); a plane moves by the tangent
# coordinates of its normal and d.


@kernel
def line_basis(line: F64, N: F64) -> None:
    """Fill N (3, 2) with two directions perpendicular to a line (2, 3)."""
    n = np.empty(3)
    size = 0.0
    for j in range(3):
        n[j] = line[1, j] - line[0, j]
        size += n[j] * n[j]
    n /= max(np.sqrt(size), 1e-12)
    tangent_columns(n, N)


@kernel
def share_opposite(R: F64, t: F64, line: F64, pixel: F64, camera: F64) -> float:
    """Parameter along a world line (2, 3; 0 = start, 1 = end) of its point nearest to the ray through a pixel; at most EXTEND beyond its ends."""
    x, y = (pixel[0] - camera[2]) / camera[0], (pixel[1] - camera[3]) / camera[1]
    r0, r1, r2 = R[0, 0] * x + R[0, 1] * y + R[0, 2], R[1, 0] * x + R[1, 1] * y + R[1, 2], R[2, 0] * x + R[2, 1] * y + R[2, 2]
    a0, a1, a2 = line[1, 0] - line[0, 0], line[1, 1] - line[0, 1], line[1, 2] - line[0, 2]
    rr, ra = r0 * r0 + r1 * r1 + r2 * r2, r0 * a0 + r1 * a1 + r2 * a2
    n0, n1, n2 = a0 * rr - r0 * ra, a1 * rr - r1 * ra, a2 * rr - r2 * ra  # across the ray, in the plane it spans with the line
    top = -(line[0, 0] - t[0]) * n0 - (line[0, 1] - t[1]) * n1 - (line[0, 2] - t[2]) * n2
    bottom = a0 * n0 + a1 * n1 + a2 * n2
    share = top / bottom if bottom > 1e-12 else 0.0
    return min(max(share, -EXTEND), 1.0 + EXTEND)


@kernel
def line_term(R: F64, t: F64, line: F64, N: F64, share: float, segment_px: F64, camera: F64, J: F64, p: F64) -> tuple[float, float]:
    """Distance (px) from the observed segment (2, 2) of the line's point at parameter `share`, and the parameter along the segment (eq. 4).

    NaN behind the camera. J (10,): by the pose, and by the tangent coordinates in N (3, 2) of the line's two points. Fills p (3,), that point in the
    camera frame."""
    x = (1.0 - share) * line[0, 0] + share * line[1, 0] - t[0]
    y = (1.0 - share) * line[0, 1] + share * line[1, 1] - t[1]
    z = (1.0 - share) * line[0, 2] + share * line[1, 2] - t[2]
    for k in range(3):
        p[k] = R[0, k] * x + R[1, k] * y + R[2, k] * z
    r, along = line_residual(p, segment_px, camera, J)
    _line_jacobian(R, N, share, J[0], J[1], J[2], p, J)
    return r, along


@kernel
def line_depth_term(R: F64, N: F64, share: float, observed_m: F64, m: F64, J: F64, p: F64) -> tuple[float, float]:
    """`line_term` for the distance (m) of the camera-frame point p from the observed 3D segment (2, 3) along m (3,)."""
    _line_jacobian(R, N, share, m[0], m[1], m[2], p, J)
    return line_depth_residual(p, observed_m, m)


@kernel
def _line_jacobian(R: F64, N: F64, share: float, a: float, b: float, c: float, p: F64, J: F64) -> None:
    """Chain the derivative (a, b, c) by the camera-frame point p to J (10,) of `line_term`."""
    J[0], J[1], J[2] = -a, -b, -c
    J[3], J[4], J[5] = b * p[2] - c * p[1], c * p[0] - a * p[2], a * p[1] - b * p[0]
    d0, d1, d2 = a * R[0, 0] + b * R[0, 1] + c * R[0, 2], a * R[1, 0] + b * R[1, 1] + c * R[1, 2], a * R[2, 0] + b * R[2, 1] + c * R[2, 2]
    for k in range(2):
        J[6 + k] = (1.0 - share) * d0 * N[0, k] + (1.0 - share) * d1 * N[1, k] + (1.0 - share) * d2 * N[2, k]
        J[8 + k] = share * d0 * N[0, k] + share * d1 * N[1, k] + share * d2 * N[2, k]


@kernel
def _end_variance(s: float, m: F64, covariance: F64) -> float:
    """Variance along m at parameter s of an observed 3D segment whose ends have the covariances (2, 3, 3)."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += m[i] * m[j] * ((1.0 - s) ** 2 * covariance[0, i, j] + s * s * covariance[1, i, j])
    return total


@kernel
def plane_jacobian(R: F64, t: F64, world: F64, B: F64, J: F64) -> None:
    """Jacobian J (3, 3) of `plane_residual` of kind SAME by (a, b, d) of the world plane; B is the tangent basis of the observed normal."""
    Bw = np.empty((3, 2))
    tangent_columns(world, Bw)
    J[:] = 0.0
    for j in range(2):
        for k in range(2):
            for i in range(3):
                J[k, j] += B[i, k] * (R[0, i] * Bw[0, j] + R[1, i] * Bw[1, j] + R[2, i] * Bw[2, j])
        J[2, j] = t[0] * Bw[0, j] + t[1] * Bw[1, j] + t[2] * Bw[2, j]
    J[2, 2] = 1.0


@kernel
def relation_residual(kind: int, first: F64, second: F64, B: F64, r: F64, J_first: F64, J_second: F64) -> int:
    """Residual r (2,) of parallel or perpendicular world planes (eq. 8), Jacobians (2, 3) by (a, b, d) of each; returns the number of rows.

    PARALLEL: the difference of the normals, for either orientation, in B (3, 2), the tangent basis of the second. PERPENDICULAR: their dot
    product."""
    A, S = np.empty((3, 2)), np.empty((3, 2))
    tangent_columns(first, A)
    tangent_columns(second, S)
    J_first[:], J_second[:] = 0.0, 0.0
    dot = first[0] * second[0] + first[1] * second[1] + first[2] * second[2]
    if kind != PARALLEL:
        r[0] = dot
        for j in range(2):
            for i in range(3):
                J_first[0, j] += second[i] * A[i, j]
                J_second[0, j] += first[i] * S[i, j]
        return 1
    sign = -1.0 if dot < 0.0 else 1.0
    for k in range(2):
        r[k] = 0.0
        for i in range(3):
            r[k] += B[i, k] * (sign * first[i] - second[i])
            for j in range(2):
                J_first[k, j] += sign * B[i, k] * A[i, j]
                J_second[k, j] -= B[i, k] * S[i, j]
    return 2


# Robust weights and normal equations of all observations, points and lines separate from poses and planes.

SQUARES, HUBER, TRUNCATED = 0, 1, 2


class NormalEquations(NamedTuple):
    """`[H W; Wᵀ V] dx = -[g; b]`: H (lower triangle) and g over the free poses (6 each) and the planes (3 each); a 4 × 4 block V for each
    point (padded) and line, and a block of W for each of their observations, points first. Blocks of fixed keyframes are not used.

    A point observed once constrains no pose: its term is not in H and g, nor does the Schur complement subtract it from them."""

    H: F64  # (c, c)
    g: F64  # (c,)
    V: F64  # (l, 4, 4)
    b: F64  # (l, 4)
    W: F64  # (o, 6, 4)


@kernel
def _loss(chi2: float, limit: float, loss: int) -> tuple[float, float]:
    """Weight and cost of a term beyond the gate `limit` on its χ², under a loss."""
    if loss == SQUARES or chi2 <= limit:
        return 1.0, chi2
    if loss == HUBER:
        return np.sqrt(limit / chi2), 2.0 * np.sqrt(limit * chi2) - limit
    return 0.0, limit


@kernel
def _clear(W: F64) -> None:
    """Zero the block (6, 4) of W of an observation that is skipped."""
    for i in range(6):
        for j in range(4):
            W[i, j] = 0.0


@kernel
def _add_points(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations, filled: bool) -> float:
    """Add all points: `point_residual` and its Jacobians in scalars, since points are most of the work. Returns the cost.

    With D = dr/dp, A = DᵀWD and P = [p]×, the Jacobian by the pose is (-D, DP) and that by the point is DRᵀ."""
    cost, H, g, V, W = 0.0, out.H, out.g, out.V, out.W
    E, B = np.empty((6, 3)), np.empty(3)
    for i in range(len(state.points)):
        for o in range(seen.point_starts[i], seen.point_starts[i + 1]):
            k, z = seen.point_keyframes[o], seen.depth_m[o]
            R, deep = state.rotations[k], np.isfinite(z)
            x, y = state.points[i, 0] - state.positions[k, 0], state.points[i, 1] - state.positions[k, 1]
            d = state.points[i, 2] - state.positions[k, 2]
            p0, p1, p2 = R[0, 0] * x + R[1, 0] * y + R[2, 0] * d, R[0, 1] * x + R[1, 1] * y + R[2, 1] * d, R[0, 2] * x + R[1, 2] * y + R[2, 2] * d
            if not p2 > NEAR_M:
                cost += BEHIND
                _clear(out.W[o])
                continue
            iz = 1.0 / p2
            d00, d11, d22 = seen.intrinsics[k, 0] * iz, seen.intrinsics[k, 1] * iz, -iz * iz if deep else 0.0
            d02, d12 = -d00 * p0 * iz, -d11 * p1 * iz
            r0 = d00 * p0 + seen.intrinsics[k, 2] - seen.pixels[o, 0]
            r1 = d11 * p1 + seen.intrinsics[k, 3] - seen.pixels[o, 1]
            r2 = iz - 1.0 / z if deep else 0.0
            w, v = 1.0 / seen.sigma_px[o] ** 2, (z * z / seen.sigma_m[o]) ** 2 if deep else 0.0
            weight, share = _loss(w * (r0 * r0 + r1 * r1) + v * r2 * r2, CHI2_95[3] if deep else CHI2_95[2], loss)
            cost += share
            if not filled:
                continue
            w, v = w * weight, v * weight
            a00, a02, a11, a12 = w * d00 * d00, w * d00 * d02, w * d11 * d11, w * d11 * d12
            a22 = w * (d02 * d02 + d12 * d12) + v * d22 * d22
            b0, b1, b2 = w * d00 * r0, w * d11 * r1, w * (d02 * r0 + d12 * r1) + v * d22 * r2
            for j in range(3):  # rows of A Rᵀ and of P A Rᵀ, and R b
                e0 = a00 * R[j, 0] + a02 * R[j, 2]
                e1 = a11 * R[j, 1] + a12 * R[j, 2]
                e2 = a02 * R[j, 0] + a12 * R[j, 1] + a22 * R[j, 2]
                E[0, j], E[1, j], E[2, j] = e0, e1, e2
                E[3, j], E[4, j], E[5, j] = p1 * e2 - p2 * e1, p2 * e0 - p0 * e2, p0 * e1 - p1 * e0
                B[j] = R[j, 0] * b0 + R[j, 1] * b1 + R[j, 2] * b2
            for j in range(3):
                out.b[i, j] += B[j]
                for a in range(j + 1):
                    V[i, j, a] += R[j, 0] * E[0, a] + R[j, 1] * E[1, a] + R[j, 2] * E[2, a]
            if k >= seen.free:
                continue
            for a in range(6):
                W[o, a, 0], W[o, a, 1], W[o, a, 2], W[o, a, 3] = -E[a, 0], -E[a, 1], -E[a, 2], 0.0
            if seen.point_starts[i + 1] - seen.point_starts[i] == 1:
                continue
            m00, m01, m02 = p1 * a02, p1 * a12 - p2 * a11, p1 * a22 - p2 * a12  # P A
            m10, m11, m12 = p2 * a00 - p0 * a02, -p0 * a12, p2 * a02 - p0 * a22
            m20, m21, m22 = -p1 * a00, p0 * a11, p0 * a12 - p1 * a02
            f = 6 * k
            H[f, f] += a00
            H[f + 1, f + 1] += a11
            H[f + 2, f] += a02
            H[f + 2, f + 1] += a12
            H[f + 2, f + 2] += a22
            H[f + 3, f] += m00
            H[f + 3, f + 1] += m01
            H[f + 3, f + 2] += m02
            H[f + 4, f] += m10
            H[f + 4, f + 1] += m11
            H[f + 4, f + 2] += m12
            H[f + 5, f] += m20
            H[f + 5, f + 1] += m21
            H[f + 5, f + 2] += m22
            H[f + 3, f + 3] += p1 * m02 - p2 * m01
            H[f + 4, f + 3] += p1 * m12 - p2 * m11
            H[f + 4, f + 4] += p2 * m10 - p0 * m12
            H[f + 5, f + 3] += p1 * m22 - p2 * m21
            H[f + 5, f + 4] += p2 * m20 - p0 * m22
            H[f + 5, f + 5] += p0 * m21 - p1 * m20
            g[f] -= b0
            g[f + 1] -= b1
            g[f + 2] -= b2
            g[f + 3] -= p1 * b2 - p2 * b1
            g[f + 4] -= p2 * b0 - p0 * b2
            g[f + 5] -= p0 * b1 - p1 * b0
    return cost


@kernel
def _add_lines(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations, filled: bool) -> float:
    """Add all lines: both ends of each observed segment against the points of the line opposite to them, in the image (rows 0 and 1) and, where
    the segment has a 3D line, in depth (rows 2 and 3). Returns the cost."""
    cost, points, observations = 0.0, len(state.points), len(seen.point_keyframes)
    N, m, p, r, w, J = np.empty((3, 2)), np.empty(3), np.empty((2, 3)), np.zeros(4), np.zeros(4), np.zeros((4, 10))
    for i in range(len(state.lines)):
        line = state.lines[i]
        line_basis(line, N)
        for o in range(seen.line_starts[i], seen.line_starts[i + 1]):
            k = seen.line_keyframes[o]
            R, t, camera = state.rotations[k], state.positions[k], seen.intrinsics[k]
            segment_px, observed_m = seen.endpoints_px[o], seen.observed_m[o]
            deep = depth_direction(observed_m, m)
            for a in range(2):
                share = share_opposite(R, t, line, segment_px[a], camera)
                r[a], s = line_term(R, t, line, N, share, segment_px, camera, J[a], p[a])
                w[a] = 1.0 / (seen.line_sigma_px**2 * ((1.0 - s) ** 2 + s * s))
                if deep:
                    r[2 + a], s = line_depth_term(R, N, share, observed_m, m, J[2 + a], p[a])
                    w[2 + a] = 1.0 / _end_variance(s, m, seen.observed_covariance_m2[o])
            x = observations + o
            if not (p[0, 2] > NEAR_M and p[1, 2] > NEAR_M):
                cost += BEHIND
                _clear(out.W[x])
                continue
            for a in range(2 if deep else 1):
                weight, share = _loss(w[2 * a] * r[2 * a] ** 2 + w[2 * a + 1] * r[2 * a + 1] ** 2, CHI2_95[2], loss)
                cost += share
                w[2 * a] *= weight
                w[2 * a + 1] *= weight
            if not filled:
                continue
            if not deep:
                w[2:], r[2:], J[2:] = 0.0, 0.0, 0.0
            _add_line(r, w, J, 6 * k if k < seen.free else -1, out.H, out.g, out.V[points + i], out.b[points + i], out.W[x])
    return cost


@kernel
def _add_line(r: F64, w: F64, J: F64, pose: int, H: F64, g: F64, V: F64, b: F64, W: F64) -> None:
    """Add four residuals r with weights w and Jacobian J (4, 10) of one line observation; `pose` is where its keyframe's parameters begin, -1 for
    a fixed keyframe; W (6, 4) is its own block. In scalars, so that none is loaded and stored four times."""
    r0, r1, r2, r3 = r[0], r[1], r[2], r[3]
    for i in range(4):
        a0, a1, a2, a3 = w[0] * J[0, 6 + i], w[1] * J[1, 6 + i], w[2] * J[2, 6 + i], w[3] * J[3, 6 + i]
        b[i] = b[i] + a0 * r0 + a1 * r1 + a2 * r2 + a3 * r3
        for j in range(6, 7 + i):
            V[i, j - 6] = V[i, j - 6] + a0 * J[0, j] + a1 * J[1, j] + a2 * J[2, j] + a3 * J[3, j]
    if pose < 0:
        return
    for i in range(6):
        a0, a1, a2, a3 = w[0] * J[0, i], w[1] * J[1, i], w[2] * J[2, i], w[3] * J[3, i]
        g[pose + i] = g[pose + i] + a0 * r0 + a1 * r1 + a2 * r2 + a3 * r3
        for j in range(i + 1):
            H[pose + i, pose + j] = H[pose + i, pose + j] + a0 * J[0, j] + a1 * J[1, j] + a2 * J[2, j] + a3 * J[3, j]
        for j in range(4):
            W[i, j] = a0 * J[0, 6 + j] + a1 * J[1, 6 + j] + a2 * J[2, 6 + j] + a3 * J[3, 6 + j]


@kernel
def _add_planes(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations) -> float:
    """Add all plane observations and all relations between planes, with Huber's loss at most. Returns the cost."""
    cost, first = 0.0, 6 * seen.free
    r, B, Jc, Jp = np.empty(3), np.empty((3, 2)), np.empty((3, 6)), np.empty((3, 3))
    for o in range(len(seen.plane_keyframes)):
        k, i = seen.plane_keyframes[o], seen.plane_landmarks[o]
        tangent_columns(seen.observed_planes[o], B)
        plane_residual(np.int32(SAME), state.rotations[k], state.positions[k], state.planes[i], seen.observed_planes[o], B, r, Jc)
        plane_jacobian(state.rotations[k], state.positions[k], state.planes[i], B, Jp)
        L, chi2 = seen.plane_information[o], 0.0
        for a in range(3):
            for b in range(3):
                chi2 += r[a] * L[a, b] * r[b]
        weight, share = _loss(chi2, CHI2_95[3], min(loss, HUBER))
        cost += share
        _add_dense(r, np.int64(3), L, Jc, 6 * k if k < seen.free else -1, np.int64(6), Jp, first + 3 * i, weight, out.H, out.g)
    L, Ja, Jb = np.eye(3), np.empty((2, 3)), np.empty((2, 3))
    for o in range(len(seen.relations)):
        kind, a, b = seen.relations[o]
        tangent_columns(state.planes[b], B)
        rows = relation_residual(kind, state.planes[a], state.planes[b], B, r, Ja, Jb)
        chi2 = (r[0] * r[0] + (r[1] * r[1] if rows == 2 else 0.0)) / seen.relation_variance[o]
        weight, share = _loss(chi2, CHI2_95[2] if kind == PARALLEL else CHI2_95[1], min(loss, HUBER))
        cost += share
        _add_dense(r, rows, L, Ja, first + 3 * a, np.int64(3), Jb, first + 3 * b, weight / seen.relation_variance[o], out.H, out.g)
    return cost


@kernel
def _add_odometry(state: BundleState, seen: BundleMeasurements, out: NormalEquations) -> float:
    """Add the motions between keyframes that are neighbours in time, with squared loss: they hold a window that few landmarks connect with the
    others. Jacobians for small residuals. Returns the cost."""
    cost = 0.0
    r, apart, A, B = np.empty(6), np.empty(3), np.zeros((6, 6)), np.eye(6)
    for e in range(len(seen.neighbours)):
        a, b = seen.neighbours[e]
        R_a, R_b = state.rotations[a], state.rotations[b]
        for j in range(3):
            apart[j] = state.positions[b, j] - state.positions[a, j]
        R, t = matmul(R_a.T, R_b), matvec(R_a.T, apart)
        Z_R, Z_t = split_pose(seen.motions[e])
        for j in range(3):
            apart[j] = t[j] - Z_t[j]
        off, turn = matvec(Z_R.T, apart), matmul(Z_R.T, R)
        r[0], r[1], r[2] = off[0], off[1], off[2]
        r[3], r[4], r[5] = log_so3(turn)
        for j in range(3):
            for k in range(3):
                A[j, k], A[3 + j, 3 + k], B[j, k] = -Z_R[k, j], -R[k, j], turn[j, k]
            A[j, 3] = Z_R[1, j] * t[2] - Z_R[2, j] * t[1]  # Z_Rᵀ [t]×
            A[j, 4] = Z_R[2, j] * t[0] - Z_R[0, j] * t[2]
            A[j, 5] = Z_R[0, j] * t[1] - Z_R[1, j] * t[0]
        L = seen.motion_information[e]
        cost += dot(r, matvec(L, r))
        W_a, W_b = matmul(A.T, L), matmul(B.T, L)
        if a < seen.free:
            add_block(matmul(W_a, A), out.H, 6 * a, 6 * a)
            for j in range(6):
                out.g[6 * a + j] += dot(W_a[j], r)
        if b < seen.free:
            add_block(matmul(W_b, B), out.H, 6 * b, 6 * b)
            for j in range(6):
                out.g[6 * b + j] += dot(W_b[j], r)
        if a < seen.free and b < seen.free:
            if a < b:
                add_block(matmul(W_b, A), out.H, 6 * b, 6 * a)
            else:
                add_block(matmul(W_a, B), out.H, 6 * a, 6 * b)
    return cost


@kernel
def _add_dense(r: F64, rows: int, L: F64, A: F64, a: int, size: int, B: F64, b: int, weight: float, H: F64, g: F64) -> None:
    """Add `weight · rᵀ L r` with Jacobian A (rows, size) by the parameters from a on and B (rows, 3) by those from b on, a < b or negative."""
    for i in range(rows):
        for j in range(rows):
            w = weight * L[i, j]
            for x in range(3):
                g[b + x] += w * B[i, x] * r[j]
                for y in range(x + 1):
                    H[b + x, b + y] += w * B[i, x] * B[j, y]
            if a >= 0:
                for x in range(size):
                    g[a + x] += w * A[i, x] * r[j]
                    for y in range(x + 1):
                        H[a + x, a + y] += w * A[i, x] * A[j, y]
                    for y in range(3):
                        H[b + y, a + x] += w * A[i, x] * B[j, y]


@kernel
def linearise_bundle(state: BundleState, seen: BundleMeasurements, loss: int, out: NormalEquations, filled: bool = True) -> float:
    """Fill the normal equations at a state; return the cost under a loss: SQUARES, HUBER beyond the 95 % gate of each term, or TRUNCATED there.

    Planes and their relations retain HUBER: they are few, and rejecting 5 % is too much. Where the equations need not be `filled` they are
    invalid."""
    out.H[:], out.g[:], out.V[:], out.b[:] = 0.0, 0.0, 0.0, 0.0
    cost = _add_points(state, seen, loss, out, filled)
    cost += _add_lines(state, seen, loss, out, filled)
    cost += _add_odometry(state, seen, out)
    return cost + _add_planes(state, seen, loss, out)


# Damping and prior weights: a weak prior at the current state holds what no observation constrains. Per parameter, 1/m² and 1/rad².

PRIOR_M, PRIOR_RAD, PRIOR_LANDMARK = 1.0 / 0.1**2, 1.0 / np.radians(2.0) ** 2, 1.0 / 0.5**2


@kernel
def add_damping(H: F64, free: int, damping: float, S: F64) -> None:
    """Add damping and prior weights to H: S (c, c), full."""
    for i in range(len(H)):
        for j in range(i + 1):
            S[i, j] = S[j, i] = H[i, j]
    for i in range(len(H)):
        of_angle = i % 6 >= 3 if i < 6 * free else (i - 6 * free) % 3 < 2
        S[i, i] += damping * H[i, i] + (PRIOR_RAD if of_angle else PRIOR_M)


@kernel
def _invert_block(V: F64, damping: float, point: bool, A: F64) -> None:
    """Invert the damped block V (lower triangle) of a landmark, prior weight added, into A (4, 4).

    That of a line, which is positive definite, by Gauss–Jordan elimination without pivoting."""
    for i in range(4):
        for j in range(i + 1):
            A[i, j] = A[j, i] = V[i, j]
        A[i, i] += damping * V[i, i] + PRIOR_LANDMARK
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


# The Schur complement of points and lines, and back-substitution.


@kernel
def _eliminate(A: F64, b: F64, W: F64, point: bool, keyframes: I32, begin: int, end: int, free: int, Y: F64, S: F64, y: F64) -> None:
    """Subtract one landmark, with inverse block A and observations begin to end, from the lower triangle of the reduced system.

    The fourth parameter of a `point` is padding and skipped. Y (6, 4) is scratch."""
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


@kernel
def reduce_system(normal: NormalEquations, seen: BundleMeasurements, damping: float, S: F64, y: F64, inverses: F64) -> None:
    """Schur complement: the reduced system `S dx = y` of poses and planes (S full), and the inverse blocks of points and lines (l, 4, 4)."""
    add_damping(normal.H, seen.free, damping, S)
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


@kernel
def back_substitute(normal: NormalEquations, seen: BundleMeasurements, inverses: F64, dx: F64, steps: F64) -> None:
    """Back-substitute the step dx of poses and planes into `steps` (l, 4) of points and lines."""
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


# Retraction.


@kernel
def retract(state: BundleState, free: int, dx: F64, steps: F64) -> BundleState:
    """Move the state by the steps of poses and planes (dx) and of points and lines (`steps`, (l, 4))."""
    out = BundleState(state.rotations.copy(), state.positions.copy(), state.points.copy(), state.lines.copy(), state.planes.copy())
    for k in range(free):
        retract_pose(state.rotations[k], state.positions[k], dx[6 * k : 6 * k + 6], out.rotations[k], out.positions[k])
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
        tangent_columns(state.planes[i], N)
        size = 0.0
        for j in range(3):
            out.planes[i, j] += N[j, 0] * dx[at] + N[j, 1] * dx[at + 1]
            size += out.planes[i, j] ** 2
        for j in range(3):
            out.planes[i, j] /= np.sqrt(size)
        out.planes[i, 3] += dx[at + 2]
    return out


# Marginal covariance of points and lines.


@kernel
def landmark_covariances(normal: NormalEquations, seen: BundleMeasurements, inverses: F64, covariance: F64, out: F64) -> None:
    """Fill `out` (l, 4, 4) with the marginal covariance of each point and line, `A + A Wᵀ Σ W A`, where A is its inverse block and Σ (c, c) the
    covariance of poses and planes."""
    n, first = len(seen.point_starts) - 1, len(seen.point_keyframes)
    M, Q = np.empty((4, 4)), np.zeros((4, 4))
    for i in range(len(out)):
        M[:] = 0.0
        if i < n:
            _add_cross_terms(normal.W, True, seen.point_keyframes, seen.point_starts[i], seen.point_starts[i + 1], seen.free, covariance, M)
        else:
            begin, end = seen.line_starts[i - n], seen.line_starts[i - n + 1]
            _add_cross_terms(normal.W[first:], False, seen.line_keyframes, begin, end, seen.free, covariance, M)
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


@kernel
def _add_cross_terms(W: F64, point: bool, keyframes: I32, begin: int, end: int, free: int, covariance: F64, M: F64) -> None:
    """Add the cross terms `Wᵀ Σ W` of one landmark to M (4, 4), row by row of Σ W; the fourth row and column of a `point` are skipped."""
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
