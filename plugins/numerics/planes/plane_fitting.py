"""Robust planes through the cells of a grid: dominant normal, trimmed weighted least squares in inverse depth, and a test for curvature."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, Bool
from trihedron.plugins.numerics.depth.organised_grid import Grid, cells_by_component, normal_equations
from trihedron.plugins.numerics.planes.parallel_planes import larger_surface
from trihedron.plugins.numerics.planes.plane_curvature import linear_turn

COARSE = 2000  # cells a component's first plane is estimated from


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve_symmetric(A: F64, b: F64) -> tuple[bool, F64]:
    """Solution (3,) of a symmetric positive definite 3 × 3 system by cofactors; False, and zeros, when it is singular."""
    c00, c01, c02 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2], A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2], A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    c11, c12, c22 = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2], A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2], A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    det = A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02
    x = np.zeros(3)
    if not det > 1e-14 * A[0, 0] * A[1, 1] * A[2, 2]:
        return False, x
    x[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / det
    x[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / det
    x[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / det
    return True, x


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_components(
    grid: Grid, cells: I32, starts: I32, cone: float, gate: float, curved: float, least: int, labels: I32, planes: F64, found: int
) -> int:
    """Fit one plane to each component (`cells` and `starts` as from `cells_by_component`); returns how many planes there are now.

    A plane with `least` members, whose normals lie within `cone` (rad) and turn by no more than `curved` (rad), is written to `planes[found]` as q,
    and its members get the label found + 1; the first `found` planes stay. The other cells of the component stay unlabelled."""
    flat = labels.ravel()
    for k in range(len(starts) - 1):
        if found == len(planes):
            break
        component = cells[starts[k] : starts[k + 1]]
        member = np.zeros(len(component), np.bool_)
        q, members = _fit_component(grid, component, np.cos(cone), gate, member)
        q, members, _ = larger_surface(q, grid, component, member)
        if members < least or turn(q, grid, component, member, max(len(component) // COARSE, 1)) > curved:
            continue
        planes[found] = q
        found += 1
        for i in range(len(component)):
            if member[i]:
                flat[component[i]] = found
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_labelled(grid: Grid, labels: I32, planes: F64, cone: float, gate: float, least: int) -> tuple[I32, F64]:
    """Fit a plane to each labelled region (h, w), starting from its q in `planes` (k, 3), or two where it is two parallel surfaces. Returns the
    labels of the members, and the q, of those that have `least` members by the rules of `fit_cells`, largest first."""
    out, fitted, found = np.zeros_like(labels), np.zeros((2 * len(planes), 3)), 0
    cells, starts = cells_by_component(labels - 1, least)
    flat = out.ravel()
    for k in range(len(starts) - 1):
        region = cells[starts[k] : starts[k + 1]].copy()
        q = planes[labels[region[0] // labels.shape[1], region[0] % labels.shape[1]] - 1].copy()
        for _ in range(2):
            member = np.zeros(len(region), np.bool_)
            q, members = _trimmed(q, 1, grid, region, np.cos(cone), gate, member)
            q, members, other = larger_surface(q, grid, region, member)
            if members < least:
                break
            fitted[found] = q
            found += 1
            for i in range(len(region)):
                if member[i]:
                    flat[region[i]] = found
            region, q = region[~member], other
    return out, fitted[:found]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit_component(grid: Grid, component: I32, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """q of the plane that most of a component belongs to and its number of members, which are marked; zeros when there is none."""
    some = component[:: max(len(component) // COARSE, 1)].copy()
    normal = dominant_normal(grid.normals, some, cos_cone)
    return _trimmed(start_plane(normal, grid, some, cos_cone), 0, grid, component, cos_cone, gate, member)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _trimmed(q: F64, first: int, grid: Grid, component: I32, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """Rounds of `fit_cells` with a narrowing gate, the `first` of them left out, on some of the cells and last on all: (q, number of members), which
    are marked."""
    some = component[:: max(len(component) // COARSE, 1)].copy()
    marks = np.zeros(len(some), np.bool_)
    members = 0
    for step in range(first, 4):
        if q[0] == 0.0 and q[1] == 0.0 and q[2] == 0.0:
            return q, 0
        if step < 3:
            q, members = fit_cells(q, grid, some, cos_cone, gate * (4.0, 2.0, 1.0)[step], marks)
        else:
            q, members = fit_cells(q, grid, component, cos_cone, gate, member)
    return q, members


@numba.njit(cache=True, nogil=True, error_model="numpy")
def dominant_normal(normals: F32, cells: I32, cos_cone: float) -> F64:
    """The commonest direction among the cells' normals: the fullest bin of a coarse grid over (n_x, n_y), then three mean shifts within the cone."""
    count, sums = np.zeros((21, 21), np.int32), np.zeros((21, 21, 3))
    flat = normals.reshape(-1, 3)
    for i in cells:
        a, b, d = flat[i, 0], flat[i, 1], flat[i, 2]
        u, v = int(np.rint(10.0 * a)) + 10, int(np.rint(10.0 * b)) + 10
        count[u, v] += 1
        sums[u, v, 0] += a
        sums[u, v, 1] += b
        sums[u, v, 2] += d
    best = int(np.argmax(count))
    n = sums[best // 21, best % 21]
    length = max(np.sqrt(n @ n), 1e-9)
    x, y, z = n[0] / length, n[1] / length, n[2] / length
    for _ in range(3):
        p, q, s = 0.0, 0.0, 0.0
        for i in cells:
            a, b, d = flat[i, 0], flat[i, 1], flat[i, 2]
            if a * x + b * y + d * z > cos_cone:
                p += a
                q += b
                s += d
        length = np.sqrt(p * p + q * q + s * s)
        if length < 1e-9:
            break
        x, y, z = p / length, q / length, s / length
    return np.array([x, y, z])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def start_plane(normal: F64, grid: Grid, cells: I32, cos_cone: float) -> F64:
    """q of the plane with this normal at the median distance of (at most 400 of) the cells that face its way."""
    rho, rays_x, rays_y, normals = grid.rho, grid.rays_x, grid.rays_y, grid.normals
    w = rho.shape[1]
    step = max(len(cells) // 400, 1)
    distance = np.empty(len(cells) // step + 1)
    m = 0
    for k in range(0, len(cells), step):
        r, c = cells[k] // w, cells[k] % w
        if normals[r, c, 0] * normal[0] + normals[r, c, 1] * normal[1] + normals[r, c, 2] * normal[2] > cos_cone:
            distance[m] = -(normal[0] * rays_x[c] + normal[1] * rays_y[r] + normal[2]) / rho[r, c]
            m += 1
    if m == 0:
        return np.zeros(3)
    d = np.median(distance[:m])
    return -normal / d if d > 1e-6 else np.zeros(3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_cells(q: F64, grid: Grid, cells: I32, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """One round of trimmed weighted least squares: (q, number of members). A cell is a member when its normal is within the cone of q's and its depth
    within `gate` σ of q's; `member` (per entry of `cells`) is written. A degenerate fit returns zeros, and nothing is a member."""
    rho, sigma, normals = grid.rho.ravel(), grid.sigma.ravel(), grid.normals.reshape(-1, 3)
    rays_x, rays_y, w = grid.rays_x, grid.rays_y, len(grid.rays_x)
    length, u, v, one = np.sqrt(q @ q), q[0], q[1], q[2]
    nx, ny, nz = -u / length, -v / length, -one / length
    found = 0
    for k in range(len(cells)):
        i = cells[k]
        r = i // w
        aside = normals[i, 0] * nx + normals[i, 1] * ny + normals[i, 2] * nz < cos_cone
        off = abs(u * rays_x[i - r * w] + v * rays_y[r] + one - rho[i]) > gate * sigma[i]
        member[k] = not (aside or off)
        found += member[k]
    A, b = normal_equations(grid, cells, member)
    solved, q = solve_symmetric(A, b)
    if found < 3 or not solved:
        member[:] = False
        return np.zeros(3), 0
    return q, found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turn(q: F64, grid: Grid, cells: I32, member: Bool, step: int) -> float:
    """How far the normals turn across the members (one in `step`), rad: about 0 for a plane whatever its noise, all of the angle seen for a cylinder.
    Members without a normal do not count."""
    rho, rays_x, rays_y, normals = grid.rho, grid.rays_x, grid.rays_y, grid.normals
    w = rho.shape[1]
    m = 0
    cxx, cxy, cxz, cyy, cyz, czz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # sums of x xᵀ, of n xᵀ, of x and of n
    dxx, dxy, dxz, dyx, dyy, dyz, dzx, dzy, dzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    sx, sy, sz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(0, len(cells), step):
        r, c = cells[k] // w, cells[k] % w
        if member[k] and not np.isnan(normals[r, c, 0]):
            z = 1.0 / rho[r, c]
            x, y = rays_x[c] * z, rays_y[r] * z
            nx, ny, nz = float(normals[r, c, 0]), float(normals[r, c, 1]), float(normals[r, c, 2])
            m += 1
            sx, sy, sz = sx + x, sy + y, sz + z
            tx, ty, tz = tx + nx, ty + ny, tz + nz
            cxx, cxy, cxz, cyy, cyz, czz = cxx + x * x, cxy + x * y, cxz + x * z, cyy + y * y, cyz + y * z, czz + z * z
            dxx, dxy, dxz = dxx + nx * x, dxy + nx * y, dxz + nx * z
            dyx, dyy, dyz = dyx + ny * x, dyy + ny * y, dyz + ny * z
            dzx, dzy, dzz = dzx + nz * x, dzy + nz * y, dzz + nz * z
    if m < 3:
        return 0.0
    C = np.array([[cxx, cxy, cxz], [cxy, cyy, cyz], [cxz, cyz, czz]]) / m
    D = np.array([[dxx, dxy, dxz], [dyx, dyy, dyz], [dzx, dzy, dzz]]) / m
    return linear_turn(C, D, np.array([sx, sy, sz]) / m, np.array([tx, ty, tz]) / m, -q / np.sqrt(q @ q))
