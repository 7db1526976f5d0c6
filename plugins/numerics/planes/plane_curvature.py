"""Whether regions found by their depths alone are planes: what the normals of their cells say."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, Bool
from trihedron.plugins.numerics.depth.organised_grid import Grid


@numba.njit(cache=True, nogil=True, error_model="numpy")
def linear_turn(C: F64, D: F64, mean_x: F64, mean_n: F64, normal: F64) -> float:
    """Width (rad) of the spread of a region's normals n that is linear in position x, from the means of x xᵀ, n xᵀ, x and n: the part of their
    covariance that a linear map explains, as the width of a uniform spread. Directions the region does not extend in carry no information."""
    C, D = C - np.outer(mean_x, mean_x), D - np.outer(mean_n, mean_x)
    size = np.trace(C) + 1e-12
    C += np.outer(normal, normal) * size
    for a in range(3):
        C[a, a] += 1e-9 * size
    explained = D @ np.linalg.inv(C) @ D.T
    return np.sqrt(12.0 * max(np.linalg.eigvalsh(0.5 * (explained + explained.T))[2], 0.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def normals_of_regions(labels: I32, planes: F64, grid: Grid, cos_cone: float, step: int) -> tuple[F64, F64, F64]:
    """What the normals of each region's cells say, (k,) each; those within the cone of the region's own count, in every `step`th row and column.

    How far they turn across the region, rad; σ_z over the lesser extent of the region, rad: how far a bias of one σ turns them; and their share."""
    rho, sigma, _, rays_x, rays_y, normals = grid
    h, w = labels.shape
    regions = len(planes)
    cells, facing, error = np.zeros(regions), np.zeros(regions), np.zeros(regions)
    unit, C, D = np.empty((regions, 3)), np.zeros((regions, 3, 3)), np.zeros((regions, 3, 3))
    mean_x, mean_n, x = np.zeros((regions, 3)), np.zeros((regions, 3)), np.empty(3)
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
                mean_x[k, a] += x[a]
                mean_n[k, a] += n[a]
                for b in range(3):
                    C[k, a, b] += x[a] * x[b]
                    D[k, a, b] += n[a] * x[b]
    turns, biases = np.zeros(regions), np.zeros(regions)
    for k in range(regions):
        m = facing[k]
        if m >= 3.0:
            turns[k] = linear_turn(C[k] / m, D[k] / m, mean_x[k] / m, mean_n[k] / m, unit[k])
            lesser = np.linalg.eigvalsh(C[k] / m - np.outer(mean_x[k] / m, mean_x[k] / m))[1]
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
