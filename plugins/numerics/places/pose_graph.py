"""Poses from relative poses: a sparse Levenberg–Marquardt over a graph of keyframes (Grisetti et al., ITS Magazine 2010)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from trihedron.pipeline.core.geometry import exp_so3
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.algebra.uncertainty import cross_matrices

if TYPE_CHECKING:  # imported where it is needed: SciPy is slow to load, and most runs close no loop
    from scipy.sparse import bsr_matrix

ITERATIONS, CONVERGED = 20, 1e-9  # squared length of a step, metres and radians, below which nothing moves any more
HELD = 1e12 * np.eye(6)  # information of a pose that stays
ROUGHEST = 1e8  # damping beyond which no step goes downhill


@dataclass(frozen=True)
class Edges:
    """Measured motions between nodes: `T_a_b = Z · Exp(xi)`, xi = (rho, phi) of the given information."""

    pairs: I32  # (e, 2) rows (a, b)
    measured: F64  # (e, 4, 4) Z
    information: F64  # (e, 6, 6)


def joined(*edges: Edges) -> Edges:
    """All of them."""
    pairs, measured, information = zip(*((e.pairs, e.measured, e.information) for e in edges))
    return Edges(np.concatenate(pairs), np.concatenate(measured), np.concatenate(information))


def solve_pose_graph(poses: F64, edges: Edges) -> F64:
    """(n, 4, 4) `T_world_node` that minimise the squared error of the edges, starting from `poses`. Node 0 stays where it is."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    damping, current = 1e-6, poses.copy()
    cost, H, g = _normal_equations(current, edges)
    for _ in range(ITERATIONS):
        scale = diags(H.diagonal())
        step = splu((H + damping * scale).tocsc()).solve(-g).reshape(-1, 6)
        step[0] = 0.0  # held by its weight but for rounding
        tried = _moved(current, step)
        new_cost, new_H, new_g = _normal_equations(tried, edges)
        if new_cost <= cost:
            current, cost, H, g, damping = tried, new_cost, new_H, new_g, max(damping / 10.0, 1e-9)
            if float((step**2).sum(axis=1).max()) < CONVERGED:
                break
        else:
            damping *= 100.0
            if damping > ROUGHEST:
                break
    return current


def _moved(poses: F64, steps: F64) -> F64:
    """Poses (n, 4, 4) with their frames moved by (rho, phi) (n, 6)."""
    out = poses.copy()
    out[:, :3, 3] += (poses[:, :3, :3] @ steps[:, :3, None])[..., 0]
    out[:, :3, :3] = poses[:, :3, :3] @ np.array([exp_so3(phi) for phi in steps[:, 3:]])
    return out


def _rotation_vectors(R: F64) -> F64:
    """(n, 3, 3) rotations below 180° -> (n, 3) rotation vectors."""
    axis = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0))
    return np.asarray(axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)[:, None])


def _normal_equations(poses: F64, edges: Edges) -> tuple[float, bsr_matrix, F64]:
    """Cost, (6n, 6n) approximate Hessian and (6n,) gradient of half the squared error."""
    a, b = edges.pairs.T
    R_a, R_b, R_z = poses[a, :3, :3], poses[b, :3, :3], edges.measured[:, :3, :3]
    R_a_t, R_z_t = np.swapaxes(R_a, 1, 2), np.swapaxes(R_z, 1, 2)
    t_a_b = (R_a_t @ (poses[b, :3, 3] - poses[a, :3, 3])[..., None])[..., 0]
    error = np.concatenate([(R_z_t @ (t_a_b - edges.measured[:, :3, 3])[..., None])[..., 0], _rotation_vectors(R_z_t @ R_a_t @ R_b)], axis=1)
    J_a, J_b = np.zeros((2, len(a), 6, 6))
    J_a[:, :3, :3], J_a[:, :3, 3:], J_a[:, 3:, 3:] = -R_z_t, R_z_t @ cross_matrices(t_a_b), -np.swapaxes(R_b, 1, 2) @ R_a
    J_b[:, :3, :3], J_b[:, 3:, 3:] = R_z_t @ R_a_t @ R_b, np.eye(3)
    W_a, W_b = np.swapaxes(J_a, 1, 2) @ edges.information, np.swapaxes(J_b, 1, 2) @ edges.information
    n = len(poses)
    blocks = np.concatenate([W_a @ J_a, W_a @ J_b, W_b @ J_a, W_b @ J_b, HELD[None]])
    rows, columns = np.concatenate([a, a, b, b, [0]]), np.concatenate([a, b, a, b, [0]])
    g = np.zeros((n, 6))
    np.add.at(g, a, (W_a @ error[..., None])[..., 0])
    np.add.at(g, b, (W_b @ error[..., None])[..., 0])
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
