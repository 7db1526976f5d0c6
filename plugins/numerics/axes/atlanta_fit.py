"""Rotations that share their third axis, fitted together to directions on any of their axes."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.algebra.small_linear import solve_positive, turn_left


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_shared_vertical(
    directions: F64, information: F64, columns: I32, counted: int, rotations: F64, prior: float, gate: float, iterations: int
) -> tuple[F64, F64, float, float]:
    """Rotations (k, 3, 3) with one and the same third axis that best fit measured directions (n, 3), signs free.

    `columns` (n,) is 3 frame + axis, -1 takes no part; `information` (n, 3, 3) in 1/rad², zero along the direction. Gauss–Newton with Cauchy weights,
    one half at `gate` σ, over the tilt of the vertical about the first frame's two other axes and a turn of each frame about the vertical; `prior`
    (1/rad²) holds what nothing tells. Returns the rotations, the information (2 + k, 2 + k) of these numbers, and of the first `counted` rows
    the weighted χ² and the weighted number of its components."""
    frames = len(rotations)
    rotations, size = rotations.copy(), 2 + frames
    H, g, x = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    J, LJ, r, phi = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    chi2, components = 0.0, 0.0
    for remaining in range(iterations, -1, -1):
        H[:] = 0.0
        g[:] = 0.0
        chi2, components = 0.0, 0.0
        for i in range(len(directions)):
            if columns[i] < 0:
                continue
            frame, axis = columns[i] // 3, columns[i] % 3
            a, L = rotations[frame, :, axis], information[i]
            sign = 1.0 if directions[i, 0] * a[0] + directions[i, 1] * a[1] + directions[i, 2] * a[2] > 0.0 else -1.0
            for k in range(3):
                r[k] = sign * directions[i, k] - a[k]
            for j in range(3):  # d(phi × a) for the three turns
                about = rotations[0, :, j] if j < 2 else rotations[frame, :, 2]
                for k in range(3):
                    p, q = (k + 1) % 3, (k + 2) % 3
                    J[k, j] = about[p] * a[q] - about[q] * a[p]
            m2 = 0.0
            for k in range(3):
                for m in range(3):
                    m2 += r[k] * L[k, m] * r[m]
                    LJ[k, m] = L[k, 0] * J[0, m] + L[k, 1] * J[1, m] + L[k, 2] * J[2, m]
            w = 1.0 / (1.0 + m2 / (gate * gate))
            for j in range(3):
                row = j if j < 2 else 2 + frame
                for m in range(3):
                    column = m if m < 2 else 2 + frame
                    H[row, column] += w * (J[0, j] * LJ[0, m] + J[1, j] * LJ[1, m] + J[2, j] * LJ[2, m])
                g[row] += w * (LJ[0, j] * r[0] + LJ[1, j] * r[1] + LJ[2, j] * r[2])
            if i < counted:
                chi2 += w * m2
                components += 2.0 * w
        if remaining == 0:
            break
        for k in range(size):
            H[k, k] += prior
        solve_positive(H, g, x)
        first = rotations[0].copy()
        for f in range(frames):
            for k in range(3):
                phi[k] = x[0] * first[k, 0] + x[1] * first[k, 1] + x[2 + f] * first[k, 2]
            turn_left(phi, rotations[f])
            if f > 0:  # turns about the vertical and tilts commute to first order only
                rotations[f] = shared_vertical(rotations[0], rotations[f])
    return rotations, H, chi2, components


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shared_vertical(first: F64, R: F64) -> F64:
    """R (3, 3) with the third column of `first` (3, 3), its first column staying as near as it can."""
    out = np.empty((3, 3))
    dot, norm = 0.0, 0.0
    for k in range(3):
        dot += R[k, 0] * first[k, 2]
    for k in range(3):
        out[k, 2] = first[k, 2]
        out[k, 0] = R[k, 0] - dot * first[k, 2]
        norm += out[k, 0] ** 2
    for k in range(3):
        out[k, 0] /= np.sqrt(norm)
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        out[k, 1] = out[p, 2] * out[q, 0] - out[q, 2] * out[p, 0]
    return out


def shared_covariance(H: F64, rotations: F64, unknown: float) -> F64:
    """(k, 3, 3) covariance of phi in `R <- Exp(phi) R` of each rotation, from the information H (2 + k, 2 + k) of `fit_shared_vertical`; `unknown`
    (rad²) is the variance of what nothing tells."""
    joint = np.linalg.inv(H + np.eye(len(H)) / unknown)
    out = np.empty((len(rotations), 3, 3))
    for f in range(len(rotations)):
        rows = [0, 1, 2 + f]
        out[f] = rotations[0] @ joint[np.ix_(rows, rows)] @ rotations[0].T
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))
