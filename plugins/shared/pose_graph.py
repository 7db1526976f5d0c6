"""The pose graph (Grisetti et al., ITS Magazine 2010): its edges, and its solution by sparse Levenberg–Marquardt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.covariances import cross_matrices
from trihedron.plugins.shared.lie_kernels import log_so3_each
from trihedron.plugins.shared.pose_graph_kernels import solve_envelope

if TYPE_CHECKING:  # imported where it is needed: SciPy is slow to load, and most runs close no loop
    from scipy.sparse import bsr_matrix, csr_matrix


ITERATIONS, CONVERGED = 20, 1e-9  # squared length of a step, metres and radians
FIXED = 1e12 * np.eye(6)  # information of a fixed pose
MAX_DAMPING = 1e8
DENSE = 10.0  # elements of a dense row, per root of the number of rows (Amestoy, Davis and Duff, TOMS 2004)


@dataclass(frozen=True)
class Edges:
    """Measured motions between nodes: `T_a_b = Z · Exp(xi)`, xi = (rho, phi) with the given information."""

    pairs: I32  # (e, 2) rows (a, b)
    measured: F64  # (e, 4, 4) Z
    information: F64  # (e, 6, 6)


def concatenate_edges(*edges: Edges) -> Edges:
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
        step = _solve(H + damping * scale, -g[:, None]).reshape(-1, 6)
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
    """Solve `H x = g` (6n, m) for a symmetric positive definite H (6n, 6n)."""
    H = H.tocsr()
    order = elimination_order(H)
    permuted = H[order][:, order]
    x = np.empty(g.shape)
    x[order] = solve_envelope(permuted.indptr, permuted.indices, permuted.data, g[order])
    return x


def elimination_order(H: csr_matrix) -> I32:
    """Return the rows of a symmetric matrix in the order of reverse Cuthill and McKee, which keeps its Cholesky factor narrow. Dense rows, as that of
    a direction that all nodes measure, would leave nothing to order, and come last."""
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    dense = np.diff(H.indptr) > DENSE * np.sqrt(H.shape[0])
    rest = np.flatnonzero(~dense)
    return np.append(rest[reverse_cuthill_mckee(H[rest][:, rest], symmetric_mode=True)], np.flatnonzero(dense)).astype(np.int32)


def _retract(poses: F64, steps: F64) -> F64:
    """Move the frames of poses (n, 4, 4) by steps (rho, phi) (n, 6)."""
    out = poses.copy()
    out[:, :3, 3] += matmul(poses[:, :3, :3], steps[:, :3, None])[..., 0]
    out[:, :3, :3] = matmul(poses[:, :3, :3], np.array([exp_so3(phi) for phi in steps[:, 3:]]))
    return out


def _normal_equations(poses: F64, edges: Edges) -> tuple[float, bsr_matrix, F64]:
    """Cost, (6n, 6n) approximate Hessian and (6n,) gradient of half the squared error."""
    error, J_a, J_b = _linearised(poses, edges)
    H, g = _equations(len(poses), edges, J_a, J_b, error[..., None])
    return float(np.einsum("ei,eij,ej->", error, edges.information, error)), H, g.ravel()


def edge_errors(poses: F64, edges: Edges, errors: F64) -> F64:
    """Return the errors (e, 6, m) of the motions that edges measure, where poses (n, 4, 4) have small errors (n, 6, m)."""
    a, b = edges.pairs.T
    _, J_a, J_b = _linearised(poses, edges)
    return np.asarray(matmul(J_a, errors[a]) + matmul(J_b, errors[b]))


def remaining_errors(poses: F64, edges: Edges, errors: F64, differences: F64) -> F64:
    """Return what the solution of the graph, which is linear in them, leaves of small errors (n, 6, m) of poses (n, 4, 4). `differences` (e, 6, m)
    are the `edge_errors` of the poses less those of the measured motions. Node 0 is fixed."""
    _, J_a, J_b = _linearised(poses, edges)
    H, g = _equations(len(poses), edges, J_a, J_b, differences)
    moved = _solve(H, -g).reshape(errors.shape)
    moved[0] = 0.0  # fixed but for rounding
    return np.asarray(errors + moved)


def parameter_errors(poses: F64, edges: Edges, differences: F64) -> tuple[F64, F64]:
    """Return the errors (e, 6) of the edges and their derivatives (e, 6, m) by parameters by which edges and poses err, both with the poses (n, 4, 4)
    that make the errors least, to first order (variable projection; Golub and Pereyra, 1973). `differences` are as in `remaining_errors`."""
    error, J_a, J_b = _linearised(poses, edges)
    a, b = edges.pairs.T
    both = np.concatenate([differences, error[..., None]], axis=2)
    moved = remaining_errors(poses, edges, np.zeros((len(poses), 6, both.shape[2])), both)
    left = both + matmul(J_a, moved[a]) + matmul(J_b, moved[b])
    return left[..., -1], left[..., :-1]


def _linearised(poses: F64, edges: Edges) -> tuple[F64, F64, F64]:
    """Errors (e, 6) of the edges, and their derivatives (e, 6, 6) by xi of nodes a and b."""
    a, b = edges.pairs.T
    R_a, R_b, R_z = poses[a, :3, :3], poses[b, :3, :3], edges.measured[:, :3, :3]
    R_a_t, R_z_t = np.swapaxes(R_a, 1, 2), np.swapaxes(R_z, 1, 2)
    t_a_b = matmul(R_a_t, (poses[b, :3, 3] - poses[a, :3, 3])[..., None])[..., 0]
    error = np.concatenate([matmul(R_z_t, (t_a_b - edges.measured[:, :3, 3])[..., None])[..., 0], log_so3_each(matmul(R_z_t, R_a_t, R_b))], axis=1)
    J_a, J_b = np.zeros((2, len(a), 6, 6))
    J_a[:, :3, :3], J_a[:, :3, 3:], J_a[:, 3:, 3:] = -R_z_t, matmul(R_z_t, cross_matrices(t_a_b)), matmul(-np.swapaxes(R_b, 1, 2), R_a)
    J_b[:, :3, :3], J_b[:, 3:, 3:] = matmul(R_z_t, R_a_t, R_b), np.eye(3)
    return error, J_a, J_b


def _equations(n: int, edges: Edges, J_a: F64, J_b: F64, errors: F64) -> tuple[bsr_matrix, F64]:
    """(6n, 6n) approximate Hessian, and (6n, m) gradients for errors (e, 6, m) of the edges."""
    a, b = edges.pairs.T
    W_a, W_b = matmul(np.swapaxes(J_a, 1, 2), edges.information), matmul(np.swapaxes(J_b, 1, 2), edges.information)
    blocks = np.concatenate([matmul(W_a, J_a), matmul(W_a, J_b), matmul(W_b, J_a), matmul(W_b, J_b), FIXED[None]])
    rows, columns = np.concatenate([a, a, b, b, [0]]), np.concatenate([a, b, a, b, [0]])
    g = np.zeros((n, 6, errors.shape[2]))
    np.add.at(g, a, matmul(W_a, errors))
    np.add.at(g, b, matmul(W_b, errors))
    return _assemble(blocks, rows, columns, n), g.reshape(6 * n, -1)


def _assemble(blocks: F64, rows: I32, columns: I32, n: int) -> bsr_matrix:
    """(6n, 6n) sum of 6 × 6 blocks at rows and columns of blocks."""
    from scipy.sparse import bsr_matrix

    keys, where = np.unique(rows.astype(np.int64) * n + columns, return_inverse=True)
    total = np.zeros((len(keys), 6, 6))
    np.add.at(total, where, blocks)
    starts = np.searchsorted(keys // n, np.arange(n + 1))
    return bsr_matrix((total, keys % n, starts), shape=(6 * n, 6 * n))
