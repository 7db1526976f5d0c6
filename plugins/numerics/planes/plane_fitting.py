"""Robust planes through the cells of a grid: dominant normal, trimmed weighted least squares in inverse depth, and a test for curvature."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, U8, Bool
from trihedron.plugins.numerics.algebra.ranking import median
from trihedron.plugins.numerics.depth.organised_grid import Grid, cells_by_component
from trihedron.plugins.numerics.planes.cell_columns import columns_of, mark_within, normal_equations, sum_marked, thinned, thinned_marks
from trihedron.plugins.numerics.planes.parallel_planes import larger_surface
from trihedron.plugins.numerics.planes.plane_curvature import linear_turn

MOST = 254  # regions the labels can name


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
    grid: Grid, cells: I32, starts: I32, cone: float, gate: float, curved: float, least: int, labels: U8, planes: F64, found: int
) -> int:
    """Fit one plane to each component (`cells` and `starts` as from `cells_by_component`); returns how many planes there are now.

    A plane with `least` members, whose normals lie within `cone` (rad) and turn by no more than `curved` (rad), is written to `planes[found]` as q,
    and its members get the label found + 1; the first `found` planes stay. The other cells of the component stay unlabelled."""
    flat = labels.ravel()
    for k in range(len(starts) - 1):
        if found == len(planes):
            break
        component = cells[starts[k] : starts[k + 1]]
        columns, member = columns_of(grid, component), np.zeros(len(component), np.bool_)
        some = thinned(columns)
        q, members = _fit_component(columns, some, np.cos(cone), gate, member)
        q, members, _ = larger_surface(q, grid, component, columns, some, member)
        if members < least or turn(q, some, thinned_marks(member)) > curved:
            continue
        planes[found, 0], planes[found, 1], planes[found, 2] = q[0], q[1], q[2]
        found += 1
        for i in range(len(component)):
            if member[i]:
                flat[component[i]] = found
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_labelled(grid: Grid, labels: I32, planes: F64, cone: float, gate: float, least: int) -> tuple[U8, F64]:
    """Fit a plane to each labelled region (h, w), starting from its q in `planes` (k, 3), or two where it is two parallel surfaces. Returns the
    labels of the members, and the q, of those that have `least` members by the rules of `fit_cells`, largest first and MOST at most."""
    out, fitted, found = np.zeros(labels.shape, np.uint8), np.zeros((min(2 * len(planes), MOST), 3)), 0
    cells, starts = cells_by_component(labels - 1, least)
    flat = out.ravel()
    for k in range(len(starts) - 1):
        region = cells[starts[k] : starts[k + 1]].copy()
        q = planes[labels[region[0] // labels.shape[1], region[0] % labels.shape[1]] - 1].copy()
        for _ in range(2):
            columns, member = columns_of(grid, region), np.zeros(len(region), np.bool_)
            some = thinned(columns)
            q, members = _trimmed(q, 1, columns, some, np.cos(cone), gate, member)
            q, members, other = larger_surface(q, grid, region, columns, some, member)
            if members < least or found == len(fitted):
                break
            fitted[found] = q
            found += 1
            for i in range(len(region)):
                if member[i]:
                    flat[region[i]] = found
            region, q = region[~member], other
    return out, fitted[:found]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit_component(columns: F64, some: F64, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """q of the plane that most of a component belongs to and its number of members, which are marked; zeros when there is none."""
    return _trimmed(start_plane(dominant_normal(some, cos_cone), some, cos_cone), 0, columns, some, cos_cone, gate, member)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _trimmed(q: F64, first: int, columns: F64, some: F64, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """Rounds of trimmed weighted least squares with a narrowing gate, the `first` of them left out, on some of the cells and last on all: (q, number
    of members), which are marked. A round that marks the same members has the plane of the one before."""
    marks = member if some.shape[1] == len(member) else np.zeros(some.shape[1], np.bool_)
    members = 0
    for step in range(first, 4):
        if q[0] == 0.0 and q[1] == 0.0 and q[2] == 0.0:
            return q, 0
        cells, marked = (columns, member) if step == 3 else (some, marks)
        members, changed = _mark_members(q, cells, cos_cone, gate * (4.0, 2.0, 1.0, 1.0)[step], marked)
        if changed or step == first or (step == 3 and len(marks) < len(member)):
            q, members = _fit_members(cells, marked, members)
    return q, members


@numba.njit(cache=True, nogil=True, error_model="numpy")
def dominant_normal(columns: F64, cos_cone: float) -> F64:
    """The commonest direction among the cells' normals: the fullest bin of a coarse grid over (n_x, n_y), then three mean shifts within the cone."""
    sums = np.zeros((21 * 21, 4))  # number and sum of the normals in each bin
    nx, ny, nz = columns[5], columns[6], columns[7]
    bin, count, x, y, z = 0, 0.0, 0.0, 0.0, 0.0  # of the cells before: sums in memory would wait for each other
    for i in range(len(nx)):
        here = 21 * (int(np.rint(10.0 * nx[i])) + 10) + int(np.rint(10.0 * ny[i])) + 10
        if here != bin:
            sums[bin, 0], sums[bin, 1], sums[bin, 2], sums[bin, 3] = count, x, y, z
            bin, count, x, y, z = here, sums[here, 0], sums[here, 1], sums[here, 2], sums[here, 3]
        count, x, y, z = count + 1.0, x + nx[i], y + ny[i], z + nz[i]
    sums[bin, 0], sums[bin, 1], sums[bin, 2], sums[bin, 3] = count, x, y, z
    best = 0
    for bin in range(len(sums)):
        best = bin if sums[bin, 0] > sums[best, 0] else best
    x, y, z = sums[best, 1], sums[best, 2], sums[best, 3]
    length = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    x, y, z = x / length, y / length, z / length
    everyone, inside = np.ones(len(nx), np.bool_), np.zeros(len(nx), np.bool_)
    for k in range(3):
        if not mark_within(columns, everyone, x, y, z, cos_cone, inside) and k > 0:
            break
        p, q, s = sum_marked(columns, inside)
        length = np.sqrt(p * p + q * q + s * s)
        if length < 1e-9:
            break
        x, y, z = p / length, q / length, s / length
    return np.array([x, y, z])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def start_plane(normal: F64, columns: F64, cos_cone: float) -> F64:
    """q of the plane with this normal at the median distance of (at most 400 of) the cells that face its way."""
    xs, ys, rho, nx, ny, nz = columns[0], columns[1], columns[2], columns[5], columns[6], columns[7]
    step = max(len(xs) // 400, 1)
    distance = np.empty(len(xs) // step + 1)
    m = 0
    for k in range(0, len(xs), step):
        if nx[k] * normal[0] + ny[k] * normal[1] + nz[k] * normal[2] > cos_cone:
            distance[m] = -(normal[0] * xs[k] + normal[1] * ys[k] + normal[2]) / rho[k]
            m += 1
    if m == 0:
        return np.zeros(3)
    d = median(distance[:m])
    return -normal / d if d > 1e-6 else np.zeros(3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_cells(q: F64, columns: F64, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """One round of trimmed weighted least squares: (q, number of members). A cell is a member when its normal is within the cone of q's and its depth
    within `gate` σ of q's; `member` (per cell) is written. A degenerate fit returns zeros, and nothing is a member."""
    found, _ = _mark_members(q, columns, cos_cone, gate, member)
    return _fit_members(columns, member, found)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mark_members(q: F64, columns: F64, cos_cone: float, gate: float, member: Bool) -> tuple[int, bool]:
    """Write which cells are members as in `fit_cells`: how many are, and whether these are others than were marked."""
    xs, ys, rho, sigma, nx, ny, nz = columns[0], columns[1], columns[2], columns[3], columns[5], columns[6], columns[7]
    u, v, one = q[0], q[1], q[2]
    length = np.sqrt(u * u + v * v + one * one)
    a, b, c = -u / length, -v / length, -one / length
    found, changed = 0, 0
    for k in range(len(member)):
        aside = nx[k] * a + ny[k] * b + nz[k] * c < cos_cone
        off = abs(u * xs[k] + v * ys[k] + one - rho[k]) > gate * sigma[k]
        inside = not (aside | off)
        changed += inside != member[k]
        found += inside
        member[k] = inside
    return found, changed > 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit_members(columns: F64, member: Bool, found: int) -> tuple[F64, int]:
    """(q, number of members) by weighted least squares to the marked cells; (zeros, 0) when they are degenerate, and nothing stays marked."""
    solved, q = solve_symmetric(*normal_equations(columns, member))
    if found < 3 or not solved:
        member[:] = False
        return np.zeros(3), 0
    return q, found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turn(q: F64, columns: F64, member: Bool) -> float:
    """How far the normals turn across the members, rad: about 0 for a plane whatever its noise, all of the angle seen for a cylinder.
    Members without a normal do not count."""
    m = 0
    cxx, cxy, cxz, cyy, cyz, czz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # sums of x xᵀ, of n xᵀ, of x and of n
    dxx, dxy, dxz, dyx, dyy, dyz, dzx, dzy, dzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    sx, sy, sz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(member)):
        nx, ny, nz = columns[5, k], columns[6, k], columns[7, k]
        if member[k] and nx == nx:
            z = 1.0 / columns[2, k]
            x, y = columns[0, k] * z, columns[1, k] * z
            m += 1
            sx, sy, sz = sx + x, sy + y, sz + z
            tx, ty, tz = tx + nx, ty + ny, tz + nz
            cxx, cxy, cxz, cyy, cyz, czz = cxx + x * x, cxy + x * y, cxz + x * z, cyy + y * y, cyz + y * z, czz + z * z
            dxx, dxy, dxz = dxx + nx * x, dxy + nx * y, dxz + nx * z
            dyx, dyy, dyz = dyx + ny * x, dyy + ny * y, dyz + ny * z
            dzx, dzy, dzz = dzx + nz * x, dzy + nz * y, dzz + nz * z
    C = np.array([[cxx, cxy, cxz], [cxy, cyy, cyz], [cxz, cyz, czz]])
    D = np.array([[dxx, dxy, dxz], [dyx, dyy, dyz], [dzx, dzy, dzz]])
    return linear_turn(C, D, np.array([sx, sy, sz]), np.array([tx, ty, tz]), m, -q) if m >= 3 else 0.0
