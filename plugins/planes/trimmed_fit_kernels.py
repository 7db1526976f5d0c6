"""Kernels of robust planes through the cells of a region: dominant normal, then trimmed weighted least squares in inverse depth."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32, U8, Bool
from trihedron.plugins.planes.parallel_surfaces_kernels import larger_surface
from trihedron.plugins.planes.region_cells_kernels import (
    NX,
    NY,
    NZ,
    RHO,
    SIGMA,
    X,
    Y,
    gather_cells,
    mark_within,
    normal_equations,
    solve_symmetric,
    subsample,
    sum_marked,
)
from trihedron.plugins.shared.depth_image_kernels import Grid, cells_by_component

MAX_REGIONS = 254  # regions the labels can name


@kernel
def fit_labelled(grid: Grid, labels: I32, planes: F64, cone: float, gate: float, least: int) -> tuple[U8, F64]:
    """Fit a plane to each labelled region (h, w), starting from its q in `planes` (k, 3), or two where it is two parallel surfaces. Returns the
    labels of the members, and the q, of those that have `least` members by the rules of `fit_cells`, largest first and MAX_REGIONS at most."""
    out, fitted, found = np.zeros(labels.shape, np.uint8), np.zeros((min(2 * len(planes), MAX_REGIONS), 3)), 0
    cells, starts = cells_by_component(labels - 1, least)
    flat = out.ravel()
    for k in range(len(starts) - 1):
        region = cells[starts[k] : starts[k + 1]].copy()
        q = planes[labels[region[0] // labels.shape[1], region[0] % labels.shape[1]] - 1].copy()
        for _ in range(2):
            columns, member = gather_cells(grid, region), np.zeros(len(region), np.bool_)
            sample = subsample(columns)
            q, members = _fit_trimmed(q, 1, columns, sample, np.cos(cone), gate, member)
            q, members, other = larger_surface(q, grid, region, columns, sample, member)
            if members < least or found == len(fitted):
                break
            fitted[found] = q
            found += 1
            for i in range(len(region)):
                if member[i]:
                    flat[region[i]] = found
            region, q = region[~member], other
    return out, fitted[:found]


@kernel
def fit_component(columns: F64, sample: F64, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """Fit a plane to a component of which nothing is known: q of the plane of most of its cells, zeros when there is none, and its number of members,
    which are marked."""
    return _fit_trimmed(start_plane(dominant_normal(sample, cos_cone), sample, cos_cone), 0, columns, sample, cos_cone, gate, member)


@kernel
def _fit_trimmed(q: F64, first: int, columns: F64, sample: F64, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """Refine q by four rounds of trimmed weighted least squares with a narrowing gate, from round `first`: three on the sample, the last on all.
    Returns q and the number of members, which are marked. A round that marks the same members as the one before is not solved again."""
    marks = member if sample.shape[1] == len(member) else np.zeros(sample.shape[1], np.bool_)
    members = 0
    for step in range(first, 4):
        if q[0] == 0.0 and q[1] == 0.0 and q[2] == 0.0:
            return q, 0
        cells, marked = (columns, member) if step == 3 else (sample, marks)
        members, changed = _mark_members(q, cells, cos_cone, gate * (4.0, 2.0, 1.0, 1.0)[step], marked)
        if changed or step == first or (step == 3 and len(marks) < len(member)):
            q, members = _fit_members(cells, marked, members)
    return q, members


@kernel
def dominant_normal(columns: F64, cos_cone: float) -> F64:
    """Find the most frequent direction of the cells' normals: the fullest bin of a coarse grid over (n_x, n_y), then three mean shifts."""
    sums = np.zeros((21 * 21, 4))  # number and sum of the normals in each bin
    nx, ny, nz = columns[NX], columns[NY], columns[NZ]
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


@kernel
def start_plane(normal: F64, columns: F64, cos_cone: float) -> F64:
    """q of the plane with this normal at the median distance of (at most 400 of) the cells whose normals are within the cone about it."""
    xs, ys, rho, nx, ny, nz = columns[X], columns[Y], columns[RHO], columns[NX], columns[NY], columns[NZ]
    step = max(len(xs) // 400, 1)
    distance = np.empty(len(xs) // step + 1)
    m = 0
    for k in range(0, len(xs), step):
        if nx[k] * normal[0] + ny[k] * normal[1] + nz[k] * normal[2] > cos_cone:
            distance[m] = -(normal[0] * xs[k] + normal[1] * ys[k] + normal[2]) / rho[k]
            m += 1
    if m == 0:
        return np.zeros(3)
    d = np.median(distance[:m])
    return -normal / d if d > 1e-6 else np.zeros(3)


@kernel
def fit_cells(q: F64, columns: F64, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """One round of trimmed weighted least squares: (q, number of members). A cell is a member when its normal is within the cone of q's and its depth
    within `gate` σ of q's; `member` (per cell) is written. A degenerate fit returns zeros, and nothing is a member."""
    found, _ = _mark_members(q, columns, cos_cone, gate, member)
    return _fit_members(columns, member, found)


@kernel
def _mark_members(q: F64, columns: F64, cos_cone: float, gate: float, member: Bool) -> tuple[int, bool]:
    """Mark the members as in `fit_cells`; returns their number, and True if they differ from those marked before."""
    xs, ys, rho, sigma, nx, ny, nz = columns[X], columns[Y], columns[RHO], columns[SIGMA], columns[NX], columns[NY], columns[NZ]
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


@kernel
def _fit_members(columns: F64, member: Bool, found: int) -> tuple[F64, int]:
    """(q, number of members) by weighted least squares to the marked cells; (zeros, 0) when they are degenerate, and nothing stays marked."""
    solved, q = solve_symmetric(*normal_equations(columns, member))
    if found < 3 or not solved:
        member[:] = False
        return np.zeros(3), 0
    return q, found
