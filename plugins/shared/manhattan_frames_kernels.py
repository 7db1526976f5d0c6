"""Kernels of Manhattan frames: the 24 equivalent rotations, information of directions, Procrustes, frames of perpendicular planes, refinement."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import inverse_positive, polar_rotation, tangent_columns
from trihedron.pipeline.core.types import F32, F64, I32, Bool


def _cube_rotations() -> F64:
    """The 24 rotations (24, 3, 3) that map three orthogonal axes, signs apart, onto themselves."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[order, range(3)] = signs
            if (np.cross(matrix[0], matrix[1]) == matrix[2]).all():
                found.append(matrix)
    rotations = np.array(found)
    rotations.flags.writeable = False
    return rotations


CUBE = _cube_rotations()  # (24, 3, 3)


@kernel
def nearest_equivalent(R: F64, reference: F64) -> F64:
    """Return the rotation (3, 3) nearest to `reference` of the 24 `R @ S` with the same axes up to order and sign."""
    best, highest, relative, out = 0, -4.0, np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                relative[i, j] += reference[k, i] * R[k, j]
    for n in range(24):
        trace = 0.0
        for i in range(3):
            for j in range(3):
                trace += relative[i, j] * CUBE[n, j, i]
        if trace > highest:
            best, highest = n, trace
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += R[i, k] * CUBE[best, k, j]
    return out


# Directions of planes and lines with their information (n, 3, 3) in 1/rad², zero along the direction itself.


@kernel
def measured_directions(
    planes: F64, plane_covariance: F64, plane_floor: float, ends_m: F32, end_covariance: F32, line_floor: float, means: F64, mean_sigma: F64
) -> tuple[F64, F64]:
    """Return directions (n, 3) and their information: the normals of planes (p, 4) with covariances (p, 3, 3) of (a, b, d), see `types.Planes`; lines
    through end points (l, 2, 3) with covariances (l, 2, 3, 3) each; and `means` (m, 3) with isotropic `mean_sigma` (m,). The floors (rad) are
    added in square. A row that is not finite has zero information."""
    p, lines = len(planes), len(ends_m)
    vectors, information = np.empty((p + lines + len(means), 3)), np.zeros((p + lines + len(means), 3, 3))
    C, a = np.empty((2, 2)), np.empty((2, 3))
    for i in range(p):
        known = np.isfinite(planes[i, 0] + planes[i, 1] + planes[i, 2])
        for k in range(3):
            vectors[i, k] = planes[i, k] if known else np.nan
        tangent_columns(vectors[i], a.T)
        _inverse_in_tangent_plane(plane_covariance[i], plane_floor * plane_floor, a, information[i])
    for i in range(lines):
        d = vectors[p + i]
        length2 = 0.0
        for k in range(3):
            d[k] = float(ends_m[i, 1, k]) - ends_m[i, 0, k]
            length2 += d[k] * d[k]
        known = 1e-12 < length2 < np.inf
        for k in range(3):
            d[k] = d[k] / np.sqrt(length2) if known else np.nan
        if not known:
            continue
        tangent_columns(d, a.T)
        for u in range(2):
            for v in range(2):
                C[u, v] = 0.0
                for j in range(3):
                    for k in range(3):
                        C[u, v] += a[u, j] * (float(end_covariance[i, 0, j, k]) + end_covariance[i, 1, j, k]) * a[v, k] / length2
        _inverse_in_tangent_plane(C, line_floor * line_floor, a, information[p + i])
    for i in range(len(means)):
        for j in range(3):
            vectors[p + lines + i, j] = means[i, j]
            for k in range(3):
                information[p + lines + i, j, k] = (1.0 * (j == k) - means[i, j] * means[i, k]) / mean_sigma[i] ** 2
    return vectors, information


@kernel
def _inverse_in_tangent_plane(C: F64, more: float, basis: F64, out: F64) -> None:
    """Write the information (3, 3) of a direction with covariance C (2, 2) plus `more` in its tangent plane, the rows of `basis`; nothing where that
    is no covariance."""
    p, q, r = C[0, 0] + more, C[0, 1], C[1, 1] + more
    det = p * r - q * q
    if not (0.0 < det < np.inf and p > 0.0):
        return
    for j in range(3):
        u, v = basis[0, j], basis[1, j]
        for k in range(3):
            out[j, k] = (r * u * basis[0, k] - q * (u * basis[1, k] + v * basis[0, k]) + p * v * basis[1, k]) / det


@kernel
def assign_axes(directions: F64, R: F64, cone: float) -> I32:
    """(n,) column of R (3, m) nearest to each direction, antipodes being one; -1 further than `cone` (rad) from all, or NaN."""
    out = np.full(len(directions), -1, np.int32)
    for i in range(len(directions)):
        best = np.cos(cone)
        for k in range(R.shape[1]):
            dot = abs(directions[i, 0] * R[0, k] + directions[i, 1] * R[1, k] + directions[i, 2] * R[2, k])
            if dot > best:
                best, out[i] = dot, k
    return out


# The rotation nearest to measured directions in closed form (orthogonal Procrustes: Schönemann, Psychometrika 1966).


@kernel
def procrustes(directions: F64, weights: F64, axes: I32, R: F64, prior: float) -> F64:
    """`argmin Σ w |±n − R e|² + prior/2 Σ |R_before e − R e|²` over rotations (3, 3): directions n (n, 3) with weights (n,), each on the column
    `axes[i]` of R, signs as in R; -1 takes no part. The small prior holds the unobserved directions."""
    return polar_rotation(0.5 * prior * R + _sums(directions, weights, axes, R))


@kernel
def procrustes_covariance(covariance: F64, weights: F64, axes: I32, R: F64, prior: float, scale: float) -> F64:
    """(3, 3) of phi in `R <- Exp(phi) R` for R from `procrustes`, when the directions have the 3D covariance C (n, 3, 3), which need not be that of
    the weights: `A⁻¹ (scale Σ w² [a]× C [a]×ᵀ + prior) A⁻¹` with `A = Σ w (1 − a aᵀ) + prior` and a the axis of each."""
    A, B = _normal_equations(covariance, weights, axes, R)
    inverse, out = inverse_positive(A + prior * np.eye(3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    out[i, j] += inverse[i, k] * (scale * B[k, m] + prior * (k == m)) * inverse[m, j]
    return 0.5 * (out + out.T)


@kernel
def normal_covariance(planes: F64, covariance: F64, floor: float) -> F64:
    """(n, 3, 3) covariance in 3D, rad², of the normals of planes (n, 4) with `covariance` (n, 3, 3) of (a, b, d), see `types.Planes`; `floor` (rad)
    is added in square."""
    out, basis = np.zeros((len(planes), 3, 3)), np.empty((2, 3))
    for i in range(len(planes)):
        tangent_columns(planes[i], basis.T)
        for j in range(3):
            for k in range(3):
                for u in range(2):
                    for v in range(2):
                        out[i, j, k] += basis[u, j] * (covariance[i, u, v] + floor * floor * (u == v)) * basis[v, k]
    return out


@kernel
def square_angles(directions: F64, axes: I32, R: F64) -> F64:
    """(n,) squared sine of the angle between each direction and its column of R; 0 without one."""
    out = np.zeros(len(directions))
    for i in range(len(directions)):
        k = axes[i]
        if k >= 0:
            dot = directions[i, 0] * R[0, k] + directions[i, 1] * R[1, k] + directions[i, 2] * R[2, k]
            out[i] = max(1.0 - dot * dot, 0.0)
    return out


@kernel
def inliers_and_spread(square: F64, axes: I32, weights: F64) -> tuple[I32, F64]:
    """(3,) number of the directions on each axis, and their root mean square angle, rad, by weight; NaN on an axis without. `square` from
    `square_angles`."""
    counts, sums = np.zeros(3, np.int32), np.zeros((2, 3))
    for i in range(len(axes)):
        if axes[i] >= 0:
            counts[axes[i]] += 1
            sums[0, axes[i]] += weights[i]
            sums[1, axes[i]] += weights[i] * square[i]
    return counts, np.where(sums[0] > 0.0, np.sqrt(sums[1] / np.maximum(sums[0], 1e-300)), np.nan)


@kernel
def _sums(directions: F64, weights: F64, axes: I32, R: F64) -> F64:
    """(3, 3) `Σ w ±n eᵀ`."""
    M = np.zeros((3, 3))
    for i in range(len(directions)):
        k = axes[i]
        if k >= 0:
            dot = directions[i, 0] * R[0, k] + directions[i, 1] * R[1, k] + directions[i, 2] * R[2, k]
            w = weights[i] if dot > 0.0 else -weights[i]
            for j in range(3):
                M[j, k] += w * directions[i, j]
    return M


@kernel
def _normal_equations(covariance: F64, weights: F64, axes: I32, R: F64) -> tuple[F64, F64]:
    """(3, 3) `Σ w (1 − a aᵀ)` and (3, 3) `Σ w² [a]× C [a]×ᵀ`."""
    A, B, row = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(len(weights)):
        k = axes[i]
        if k < 0:
            continue
        a, w, C = R[:, k], weights[i], covariance[i]
        for p in range(3):
            q, r = (p + 1) % 3, (p + 2) % 3
            A[p, p] += w
            for j in range(3):
                A[p, j] -= w * a[p] * a[j]
                row[p, j] = a[q] * C[r, j] - a[r] * C[q, j]  # [a]× C
        for p in range(3):
            for j in range(3):
                q, r = (j + 1) % 3, (j + 2) % 3
                B[p, j] += w * w * (row[p, r] * a[q] - row[p, q] * a[r])
    return A, B


# Frames through two perpendicular directions, and their scores.

NEAR = np.radians(15.0)  # a frame turned less than this from the previous axes is still the same


@kernel
def frames_through(first: F64, second: F64) -> F64:
    """(m, 3, 3) rotations whose first columns are the unit vectors `first` (m, 3), and whose second lie in the plane of these and `second` (m, 3),
    which must not be parallel to them."""
    out = np.empty((len(first), 3, 3))
    for i in range(len(first)):
        dot = first[i, 0] * second[i, 0] + first[i, 1] * second[i, 1] + first[i, 2] * second[i, 2]
        norm = 0.0
        for k in range(3):
            out[i, k, 0], out[i, k, 1] = first[i, k], second[i, k] - dot * first[i, k]
            norm += out[i, k, 1] ** 2
        for k in range(3):
            out[i, k, 1] /= np.sqrt(norm)
        for k in range(3):
            p, q = (k + 1) % 3, (k + 2) % 3
            out[i, k, 2] = out[i, p, 0] * out[i, q, 1] - out[i, q, 0] * out[i, p, 1]
    return out


@kernel
def score_frames(frames: F64, directions: F64, weights: F64, reach: F64) -> F64:
    """(m,) weight of the directions (n, 3) near an axis of each frame (m, 3, 3), falling off with the squared angle to 0 at `reach` (n,) rad (MSAC:
    Torr and Zisserman 2000)."""
    out = np.zeros(len(frames))
    for i in range(len(directions)):
        x, y, z, narrow = directions[i, 0], directions[i, 1], directions[i, 2], 1.0 / np.sin(reach[i]) ** 2
        for m in range(len(frames)):
            best = 0.0
            for k in range(3):
                dot = x * frames[m, 0, k] + y * frames[m, 1, k] + z * frames[m, 2, k]
                best = max(best, dot * dot)
            out[m] += weights[i] * max(1.0 - max(1.0 - best, 0.0) * narrow, 0.0)
    return out


@kernel
def same_axes(frames: F64, R: F64) -> Bool:
    """Return True (m,) where each axis of R (3, 3) is within `NEAR` of one of the frame (m, 3, 3)."""
    out = np.ones(len(frames), np.bool_)
    for m in range(len(frames)):
        for j in range(3):
            best = 0.0
            for k in range(3):
                best = max(best, abs(frames[m, 0, k] * R[0, j] + frames[m, 1, k] * R[1, j] + frames[m, 2, k] * R[2, j]))
            out[m] = out[m] and best > np.cos(NEAR)
    return out


@kernel
def best_frame(frames: F64, directions: F64, weights: F64, reach: F64, before: F64, loyalty: float) -> F64:
    """The frame (3, 3) with the highest `score_frames`, named as is nearest to the previous axes `before` (3, 3); frames with the same axes as these
    count `loyalty` times."""
    score = score_frames(frames, directions, weights, reach)
    if loyalty != 1.0:
        score *= np.where(same_axes(frames, before), loyalty, 1.0)
    return nearest_equivalent(frames[np.argmax(score)], before)


# Walls: planes with certain normals, perpendicular pairs, and the rotation nearest to those on the axes.


class Walls(NamedTuple):
    """n planes with certain normals."""

    normals: F64  # (n, 3)
    spatial: F64  # (n, 3, 3) their covariances, rad²
    variance: F64  # (n,) in a tangent coordinate, the mean of the two
    area: F64  # (n,) px


@kernel
def known_walls(planes: F64, covariance: F64, pixels: I32, floor: float) -> Walls:
    """Select the planes (n, 4) with a finite covariance (n, 3, 3) of (a, b, d); `floor` (rad) is added in square."""
    spatial = normal_covariance(planes, covariance, floor)
    variance = np.empty(len(planes))
    for i in range(len(planes)):
        variance[i] = 0.5 * (spatial[i, 0, 0] + spatial[i, 1, 1] + spatial[i, 2, 2])
    good = np.flatnonzero(np.isfinite(variance) & (variance > 0.0) & (pixels > 0))
    return Walls(np.ascontiguousarray(planes[good, :3]), spatial[good], variance[good], pixels[good].astype(np.float64))


@kernel
def perpendicular_pair(walls: Walls, max_cos: float, largest_cos: float, reach: float, before: F64, loyalty: float) -> tuple[bool, F64]:
    """Find perpendicular walls (`max_cos` and twice their uncertainty, at most `largest_cos`): True if there are, and the rotation through the pair
    that explains most area within `reach`, see `best_frame`."""
    n, count = len(walls.normals), 0
    first, second = np.empty((n * n, 3)), np.empty((n * n, 3))
    for i in range(n):
        for j in range(i + 1, n):
            a, b = walls.normals[i], walls.normals[j]
            sigma = np.sqrt(walls.variance[i] + walls.variance[j])
            if abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) <= min(max_cos + 2.0 * sigma, largest_cos):
                swap = walls.variance[j] < walls.variance[i]  # the first axis is the better known
                for k in range(3):
                    first[count, k], second[count, k] = (b[k], a[k]) if swap else (a[k], b[k])
                count += 1
    if count == 0:
        return False, before.copy()
    frames = frames_through(first[:count], second[:count])
    return True, best_frame(frames, walls.normals, walls.area, np.full(n, reach), before, loyalty)


@kernel
def area_on_axes(walls: Walls, R: F64, reach: float) -> F64:
    """Sum the area (3,) of the walls within `reach` of each column of R."""
    out, axes = np.zeros(3), assign_axes(walls.normals, R, reach)
    for i in range(len(axes)):
        if axes[i] >= 0:
            out[axes[i]] += walls.area[i]
    return out


@kernel
def refine_rotation(walls: Walls, R: F64, reach: float, gate: float, prior: float, rounds: int) -> tuple[F64, I32, F64]:
    """Refine R to the rotation nearest to the walls within `reach` of its axes, again with new axes and with Cauchy weights, one half at `gate` σ:
    the rotation, the axis of each wall (n,), -1 for none, and its weight (n,), 1/rad²."""
    axes, weights = assign_axes(walls.normals, R, reach), 1.0 / walls.variance
    for _ in range(rounds):
        R = procrustes(walls.normals, weights, axes, R, prior)
        axes = assign_axes(walls.normals, R, reach)
        weights = 1.0 / (walls.variance + square_angles(walls.normals, axes, R) / gate**2)
    return R, axes, weights
