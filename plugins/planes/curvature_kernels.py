"""Kernels that tell planes from curved surfaces by how the normals vary over a region."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot, inverse_positive
from trihedron.pipeline.core.types import F32, F64, I32, Bool
from trihedron.plugins.planes.region_cells_kernels import NX, NY, NZ, RHO, X, Y
from trihedron.plugins.shared.depth_image_kernels import Grid


@kernel
def angle_across(q: F64, columns: F64, member: Bool) -> float:
    """Estimate the angle (rad) by which the normals of the members (n,) rotate from one side of the region to the other: about 0 for a plane whatever
    its noise, the whole visible angle for a cylinder. Members without a normal do not count."""
    m = 0
    cxx, cxy, cxz, cyy, cyz, czz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # sums of x xᵀ, of n xᵀ, of x and of n
    dxx, dxy, dxz, dyx, dyy, dyz, dzx, dzy, dzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    sx, sy, sz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(member)):
        nx, ny, nz = columns[NX, k], columns[NY, k], columns[NZ, k]
        if member[k] and nx == nx:
            z = 1.0 / columns[RHO, k]
            x, y = columns[X, k] * z, columns[Y, k] * z
            m += 1
            sx, sy, sz = sx + x, sy + y, sz + z
            tx, ty, tz = tx + nx, ty + ny, tz + nz
            cxx, cxy, cxz, cyy, cyz, czz = cxx + x * x, cxy + x * y, cxz + x * z, cyy + y * y, cyz + y * z, czz + z * z
            dxx, dxy, dxz = dxx + nx * x, dxy + nx * y, dxz + nx * z
            dyx, dyy, dyz = dyx + ny * x, dyy + ny * y, dyz + ny * z
            dzx, dzy, dzz = dzx + nz * x, dzy + nz * y, dzz + nz * z
    C = np.array([[cxx, cxy, cxz], [cxy, cyy, cyz], [cxz, cyz, czz]])
    D = np.array([[dxx, dxy, dxz], [dyx, dyy, dyz], [dzx, dzy, dzz]])
    return linear_spread(C, D, np.array([sx, sy, sz]), np.array([tx, ty, tz]), float(m), q) if m >= 3 else 0.0


@kernel
def linear_spread(C: F64, D: F64, sum_x: F64, sum_n: F64, count: float, normal: F64) -> float:
    """Regress a region's normals n linearly on position x and return the width (rad) of a uniform distribution with the explained variance.

    Args: the sums C of x xᵀ, D of n xᵀ, sum_x and sum_n over `count` cells, and the normal of the region's plane, in whose direction the region has
    no extent: the regression ignores it."""
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


@kernel
def covariance(products: F64, one: F64, other: F64, count: float) -> F64:
    """Cross-covariance (3, 3) of vectors a and b from the sums of a bᵀ, a and b over `count` pairs."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = products[i, j] / count - one[i] / count * (other[j] / count)
    return out


@kernel
def eigenvalues(S: F64) -> tuple[float, float]:
    """The two largest eigenvalues of a symmetric S (3, 3), by the trigonometric solution of its cubic (Smith, 1961)."""
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


@kernel
def normal_statistics(labels: I32, planes: F64, grid: Grid, cos_cone: float, step: int) -> tuple[F64, F64, F64]:
    """Compute statistics (k,) of the normals of k regions, from every `step`th row and column; normals outside the cone about the region's own do not
    count.

    Returns: the angle by which they rotate across the region (rad, as by `linear_spread`); the rotation (rad) that a depth bias of one σ_z over the
    region's lesser extent would cause; and the share of the cells whose normals count."""
    rho, sigma, _, rays_x, rays_y, normals = grid
    h, w = labels.shape
    regions = len(planes)
    cells, facing, error = np.zeros(regions), np.zeros(regions), np.zeros(regions)
    unit, C, D = np.empty((regions, 3)), np.zeros((regions, 3, 3)), np.zeros((regions, 3, 3))
    sum_x, sum_n, x = np.zeros((regions, 3)), np.zeros((regions, 3)), np.empty(3)
    for k in range(regions):
        length = max(np.sqrt(dot(planes[k], planes[k])), 1e-12)
        for a in range(3):
            unit[k, a] = -planes[k, a] / length
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
            turns[k] = linear_spread(C[k], D[k], sum_x[k], sum_n[k], m, unit[k])
            lesser = eigenvalues(covariance(C[k], sum_x[k], sum_x[k], m))[1]
            biases[k] = error[k] / m / np.sqrt(12.0 * max(lesser, 1e-9))
    return turns, biases, facing / np.maximum(cells, 1.0)


@kernel
def drop_engulfed(labels: I32, rho: F32, good: Bool, gap: int) -> Bool:
    """Clear `good` (k,) for regions of whose border, where depth goes on, at least half is within `gap` cells of regions that are not good: a strip
    between strips of a curved surface belongs to it, although it is too narrow to show curvature."""
    h, w = labels.shape
    regions = len(good)
    adjacent = np.zeros((regions + 1, regions + 1))  # sides of cells by label and the label across, 0 = none near
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
                    adjacent[a, near] += 1.0
    out = good.copy()
    again = True
    while again:
        again = False
        for k in range(regions):
            if out[k]:
                bad = 0.0
                for j in range(regions):
                    if not out[j]:
                        bad += adjacent[k + 1, j + 1]
                if bad > 0.0 and bad >= 0.5 * adjacent[k + 1].sum():
                    out[k], again = False, True
    return out
