"""The pose graph over keyframes (Grisetti et al., ITS Magazine 2010): its edges, its solution, and the correction of the map that follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform_each
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, I32, Correction, Map, Table
from trihedron.plugins.loop.common_pose_graph_kernels import solve_envelope
from trihedron.plugins.mapping.covisibility_graph import odometry
from trihedron.plugins.mapping.landmarks import ENDPOINTS, POSITION
from trihedron.plugins.mapping.plane_fusion import information_of
from trihedron.plugins.shared.lie_kernels import log_so3_each
from trihedron.plugins.shared.linalg import cross_matrices, inverse

if TYPE_CHECKING:  # imported where it is needed: SciPy is slow to load, and most runs close no loop
    from scipy.sparse import bsr_matrix

LINKS = 3  # further keyframes each is connected to, so that a stretch that was observed often stays stiff
ITERATIONS, CONVERGED = 20, 1e-9  # squared length of a step, metres and radians
FIXED = 1e12 * np.eye(6)  # information of a fixed pose
MAX_DAMPING = 1e8


@dataclass(frozen=True)
class Edges:
    """Measured motions between nodes: `T_a_b = Z · Exp(xi)`, xi = (rho, phi) with the given information."""

    pairs: I32  # (e, 2) rows (a, b)
    measured: F64  # (e, 4, 4) Z
    information: F64  # (e, 6, 6)


def joined(*edges: Edges) -> Edges:
    """Concatenate edges."""
    pairs, measured, information = zip(*((e.pairs, e.measured, e.information) for e in edges))
    return Edges(np.concatenate(pairs), np.concatenate(measured), np.concatenate(information))


def solve_pose_graph(poses: F64, edges: Edges) -> F64:
    """Minimise the squared error of the edges over `T_world_node` (n, 4, 4), from `poses`, by sparse Levenberg–Marquardt. Node 0 is fixed."""
    from scipy.sparse import diags

    damping, current = 1e-6, poses.copy()
    cost, H, g = _normal_equations(current, edges)
    for _ in range(ITERATIONS):
        scale = diags(H.diagonal())
        step = _solve(H + damping * scale, -g).reshape(-1, 6)
        step[0] = 0.0  # fixed but for rounding
        tried = _retract(current, step)
        new_cost, new_H, new_g = _normal_equations(tried, edges)
        if new_cost <= cost:
            current, cost, H, g, damping = tried, new_cost, new_H, new_g, max(damping / 10.0, 1e-9)
            if float((step**2).sum(axis=1).max()) < CONVERGED:
                break
        else:
            damping *= 100.0
            if damping > MAX_DAMPING:
                break
    return current


def _solve(H: bsr_matrix, g: F64) -> F64:
    """Solve `H x = g` for a symmetric positive definite H (6n, 6n), with nodes in the order of reverse Cuthill and McKee, which keeps the factor
    narrow."""
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    order = reverse_cuthill_mckee(H.tocsr(), symmetric_mode=True)
    permuted = H.tocsr()[order][:, order]
    x = np.empty(len(g))
    x[order] = solve_envelope(permuted.indptr, permuted.indices, permuted.data, g[order])
    return x


def _retract(poses: F64, steps: F64) -> F64:
    """Move the frames of poses (n, 4, 4) by steps (rho, phi) (n, 6)."""
    out = poses.copy()
    out[:, :3, 3] += matmul(poses[:, :3, :3], steps[:, :3, None])[..., 0]
    out[:, :3, :3] = matmul(poses[:, :3, :3], np.array([exp_so3(phi) for phi in steps[:, 3:]]))
    return out


def _normal_equations(poses: F64, edges: Edges) -> tuple[float, bsr_matrix, F64]:
    """Cost, (6n, 6n) approximate Hessian and (6n,) gradient of half the squared error."""
    a, b = edges.pairs.T
    R_a, R_b, R_z = poses[a, :3, :3], poses[b, :3, :3], edges.measured[:, :3, :3]
    R_a_t, R_z_t = np.swapaxes(R_a, 1, 2), np.swapaxes(R_z, 1, 2)
    t_a_b = matmul(R_a_t, (poses[b, :3, 3] - poses[a, :3, 3])[..., None])[..., 0]
    error = np.concatenate([matmul(R_z_t, (t_a_b - edges.measured[:, :3, 3])[..., None])[..., 0], log_so3_each(matmul(R_z_t, R_a_t, R_b))], axis=1)
    J_a, J_b = np.zeros((2, len(a), 6, 6))
    J_a[:, :3, :3], J_a[:, :3, 3:], J_a[:, 3:, 3:] = -R_z_t, matmul(R_z_t, cross_matrices(t_a_b)), matmul(-np.swapaxes(R_b, 1, 2), R_a)
    J_b[:, :3, :3], J_b[:, 3:, 3:] = matmul(R_z_t, R_a_t, R_b), np.eye(3)
    W_a, W_b = matmul(np.swapaxes(J_a, 1, 2), edges.information), matmul(np.swapaxes(J_b, 1, 2), edges.information)
    n = len(poses)
    blocks = np.concatenate([matmul(W_a, J_a), matmul(W_a, J_b), matmul(W_b, J_a), matmul(W_b, J_b), FIXED[None]])
    rows, columns = np.concatenate([a, a, b, b, [0]]), np.concatenate([a, b, a, b, [0]])
    g = np.zeros((n, 6))
    np.add.at(g, a, matmul(W_a, error[..., None])[..., 0])
    np.add.at(g, b, matmul(W_b, error[..., None])[..., 0])
    cost = float(np.einsum("ei,eij,ej->", error, edges.information, error))
    return cost, _assembled(blocks, rows, columns, n), g.ravel()


def _assembled(blocks: F64, rows: I32, columns: I32, n: int) -> bsr_matrix:
    """(6n, 6n) sum of 6 × 6 blocks at rows and columns of blocks."""
    from scipy.sparse import bsr_matrix

    keys, where = np.unique(rows.astype(np.int64) * n + columns, return_inverse=True)
    total = np.zeros((len(keys), 6, 6))
    np.add.at(total, where, blocks)
    starts = np.searchsorted(keys // n, np.arange(n + 1))
    return bsr_matrix((total, keys % n, starts), shape=(6 * n, 6 * n))


# Edges and corrections of a map.


def odometry_edges(map: Map, rows: I32, drift: float, rotation_drift: float) -> Edges:
    """Return edges between neighbours in time; their covariance is that of the later keyframe's pose plus the drift along the path: standard
    deviations per square root of a metre, m and rad."""
    pairs = np.concatenate([np.stack([np.arange(len(rows) - k), np.arange(k, len(rows))], axis=1) for k in range(1, LINKS + 1)])
    return Edges(pairs.astype(np.int32), *odometry(map, rows[pairs], drift, rotation_drift, LINKS))


def correct_keyframes(map: Map, rows: I32, before: F64, after: F64) -> Correction:
    """Return the correction that moves keyframes `rows` from poses (n, 4, 4) to others, and each landmark by the mean motion of its observers."""
    motions = np.broadcast_to(np.eye(4), (len(map.keyframes), 4, 4)).copy()
    motions[rows] = matmul(after, invert(before))
    (points, T_points), (lines, T_lines), (planes, T_planes) = (_mean_motion(table, motions) for table in (map.points, map.lines, map.planes))
    coefficients = _transform_planes(T_planes, map.planes.rows("coefficients", planes))
    moments = matmul(T_planes, map.planes.rows("moments", planes), np.swapaxes(T_planes, 1, 2))
    return Correction(
        map.index, map.stamp_ns, map.revision, rows, after,
        points, POSITION.rounded(transform_each(T_points, map.points.rows("position_m", points)[:, None])[:, 0]),
        _rotate_information(T_points, map.points.rows("information", points)),
        lines, ENDPOINTS.rounded(transform_each(T_lines, map.lines.rows("endpoints_m", lines))),
        _rotate_information(T_lines[:, None], map.lines.rows("information", lines)),
        planes, coefficients, inverse(information_of(moments, coefficients)),
    )  # fmt: skip


def _mean_motion(table: Table, motions: F64) -> tuple[I32, F64]:
    """Living landmarks (n,) and the mean (n, 4, 4) of the motions (k, 4, 4) of each one's observers; between similar motions it is rigid."""
    ids = np.flatnonzero(table.column("alive")).astype(np.int32)
    total, count = np.zeros((len(ids), 4, 4)), np.zeros(len(ids))
    for column in table.rows("observers", ids).T:
        known = column >= 0
        total[known] += motions[column[known]]
        count += known
    total[count == 0.0], count[count == 0.0] = np.eye(4), 1.0
    return ids, total / count[:, None, None]


def _rotate_information(T: F64, information: F32) -> F32:
    """Rotate information matrices (..., 3, 3) by motions (..., 4, 4)."""
    return np.asarray(matmul(T[..., :3, :3], information, np.swapaxes(T[..., :3, :3], -1, -2)), np.float32)


def _transform_planes(T: F64, planes: F64) -> F64:
    """Transform planes (n, 4), each by its own motion (n, 4, 4)."""
    n = matmul(T[:, :3, :3], planes[:, :3, None])[..., 0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.concatenate([n, planes[:, 3:] - np.einsum("ni,ni->n", n, T[:, :3, 3])[:, None]], axis=1)
