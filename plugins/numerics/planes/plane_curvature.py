"""Whether regions found by their depths alone are planes: what the normals of their cells say."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, Bool
from trihedron.plugins.numerics.algebra.small_linear import inverse_positive
from trihedron.plugins.numerics.depth.organised_grid import Grid


@numba.njit(cache=True, nogil=True, error_model="numpy")
def linear_turn(C: F64, D: F64, sum_x: F64, sum_n: F64, count: float, normal: F64) -> float:
    """Width (rad) of the spread of a region's normals n that is linear in position x, from the sums of x xᵀ, n xᵀ, x and n over its cells: the part
    of their covariance that a linear map explains, as the width of a uniform spread. Directions the region does not extend in say nothing."""
    spread, joint, explained = covariance(C, sum_x, sum_x, count), covariance(D, sum_n, sum_x, count), np.zeros((3, 3))
    size = spread[0, 0] + spread[1, 1] + spread[2, 2] + 1e-12
    square = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
    for i in range(3):
        for j in range(3):
            spread[i, j] += normal[i] * normal[j] / square * size + (1e-9 * size if i == j else 0.0)
    inverse = inverse_positive(spread)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    explained[i, j] += joint[i, k] * inverse[k, m] * joint[j, m]
    return np.sqrt(12.0 * max(eigenvalues(explained)[0], 0.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def covariance(products: F64, one: F64, other: F64, count: float) -> F64:
    """(3, 3) from the sums of a bᵀ, a and b over `count` pairs."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = products[i, j] / count - one[i] / count * (other[j] / count)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def eigenvalues(S: F64) -> tuple[float, float]:
    """The two largest of a symmetric S (3, 3), by the angle of its cubic (Smith, 1961)."""
    mean, p, K = (S[0, 0] + S[1, 1] + S[2, 2]) / 3.0, 0.0, S.copy()
    for i in range(3):
        K[i, i] -= mean
        for j in range(3):
            p += K[i, j] * K[i, j] / 6.0
    if p == 0.0:
        return mean, mean
    half = 0.5 * (K[0, 0] * (K[1, 1] * K[2, 2] - K[1, 2] * K[1, 2]) - K[0, 1] * (K[0, 1] * K[2, 2] - K[1, 2] * K[0, 2]))
    half += 0.5 * K[0, 2] * (K[0, 1] * K[1, 2] - K[1, 1] * K[0, 2])
    angle, width = np.arccos(min(max(half / (p * np.sqrt(p)), -1.0), 1.0)) / 3.0, 2.0 * np.sqrt(p)
    return mean + width * np.cos(angle), mean + width * np.cos(angle - 2.0 * np.pi / 3.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def normals_of_regions(labels: I32, planes: F64, grid: Grid, cos_cone: float, step: int) -> tuple[F64, F64, F64]:
    """What the normals of each region's cells say, (k,) each; those within the cone of the region's own count, in every `step`th row and column.

    How far they turn across the region, rad; σ_z over the lesser extent of the region, rad: how far a bias of one σ turns them; and their share."""
    rho, sigma, _, rays_x, rays_y, normals = grid
    h, w = labels.shape
    regions = len(planes)
    cells, facing, error = np.zeros(regions), np.zeros(regions), np.zeros(regions)
    unit, C, D = np.empty((regions, 3)), np.zeros((regions, 3, 3)), np.zeros((regions, 3, 3))
    sum_x, sum_n, x = np.zeros((regions, 3)), np.zeros((regions, 3)), np.empty(3)
    for k in range(regions):
        unit[k] = -planes[k] / max(np.sqrt(planes[k] @ planes[k]), 1e-12)
    for r in range(0, h, step):
        for c in range(0, w, step):
            k = labels[r, c] - 1
            if k < 0 or rho[r, c] <= 0.0:
                continue
            cells[k] += 1.0
            n = normals[r, c]
            if not n[0] * unit[k, 0] + n[1] * unit[k, 1] + n[2] * unit[k, 2] >= cos_cone:
                continue
            facing[k] += 1.0
            z = 1.0 / rho[r, c]
            error[k] += sigma[r, c] * z * z
            x[0], x[1], x[2] = rays_x[c] * z, rays_y[r] * z, z
            for a in range(3):
                sum_x[k, a] += x[a]
                sum_n[k, a] += n[a]
                for b in range(3):
                    C[k, a, b] += x[a] * x[b]
                    D[k, a, b] += n[a] * x[b]
    turns, biases = np.zeros(regions), np.zeros(regions)
    for k in range(regions):
        m = facing[k]
        if m >= 3.0:
            turns[k] = linear_turn(C[k], D[k], sum_x[k], sum_n[k], m, unit[k])
            lesser = eigenvalues(covariance(C[k], sum_x[k], sum_x[k], m))[1]
            biases[k] = error[k] / m / np.sqrt(12.0 * max(lesser, 1e-9))
    return turns, biases, facing / np.maximum(cells, 1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def drop_engulfed(labels: I32, rho: F32, good: Bool, gap: int) -> Bool:
    """`good` (k,) less the regions at least half of whose border, where depth goes on, is within `gap` cells of regions that are not: a strip between
    strips of a curved surface is one of it, though too narrow to show."""
    h, w = labels.shape
    regions = len(good)
    touch = np.zeros((regions + 1, regions + 1))  # sides of cells by label and the label across, 0 = none near
    for r in range(h):
        for c in range(w):
            a = labels[r, c]
            inside = 0 < r < h - 1 and 0 < c < w - 1 and labels[r - 1, c] == a and labels[r + 1, c] == a
            if a == 0 or (inside and labels[r, c - 1] == a and labels[r, c + 1] == a):
                continue
            for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                s, d, near, measured = r + down, c + right, 0, False
                for _ in range(gap):
                    if s < 0 or s >= h or d < 0 or d >= w:
                        break
                    near, measured = labels[s, d], measured or rho[s, d] > 0.0
                    if near > 0:
                        break
                    s, d = s + down, d + right
                if near != a and measured:
                    touch[a, near] += 1.0
    out = good.copy()
    again = True
    while again:
        again = False
        for k in range(regions):
            if out[k]:
                bad = 0.0
                for j in range(regions):
                    if not out[j]:
                        bad += touch[k + 1, j + 1]
                if bad > 0.0 and bad >= 0.5 * touch[k + 1].sum():
                    out[k], again = False, True
    return out
