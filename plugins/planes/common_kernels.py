"""Numba kernels of `common.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot, inverse_positive, matvec, solve_positive, tangent_columns
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool
from trihedron.plugins.shared.depth_image_kernels import Grid, cells_by_component
from trihedron.plugins.shared.sorting_kernels import descending

# Robust planes through the cells of a grid: dominant normal, trimmed weighted least squares in inverse depth, and a test for curvature.

MOST = 254  # regions the labels can name


@kernel
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


@kernel
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


@kernel
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


@kernel
def _fit_component(columns: F64, some: F64, cos_cone: float, gate: float, member: Bool) -> tuple[F64, int]:
    """q of the plane that most of a component belongs to and its number of members, which are marked; zeros when there is none."""
    return _trimmed(start_plane(dominant_normal(some, cos_cone), some, cos_cone), 0, columns, some, cos_cone, gate, member)


@kernel
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


@kernel
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


@kernel
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


@kernel
def _fit_members(columns: F64, member: Bool, found: int) -> tuple[F64, int]:
    """(q, number of members) by weighted least squares to the marked cells; (zeros, 0) when they are degenerate, and nothing stays marked."""
    solved, q = solve_symmetric(*normal_equations(columns, member))
    if found < 3 or not solved:
        member[:] = False
        return np.zeros(3), 0
    return q, found


@kernel
def turn(q: F64, columns: F64, member: Bool) -> float:
    """Angle by which the normals turn across the members, rad: about 0 for a plane whatever its noise, all of the angle seen for a cylinder.
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


# Labelled planar regions on a grid: growth to their borders, sums over their cells, and which are the largest.


@kernel
def grow_regions(labels: U8, planes: F64, grid: Grid, gate: float, reach: int, cos_cone: float) -> U8:
    """Labels (h, w), grown ring by ring into unlabelled cells whose depth is within `gate` σ of the neighbouring region's q; returns a copy.

    A cell goes to the plane that explains it best. For `reach` rings normals do not count (they are blurred or missing near a border); beyond, a
    normal must be missing or lie within the cone."""
    rho, sigma, _, rays_x, rays_y, normals = grid
    h, w = labels.shape
    out = labels.copy()
    offered = np.zeros((h, w), np.uint8)
    residual = np.empty((h, w), np.float32)
    flat, flat_offered = out.ravel(), offered.ravel()
    frontier = _border(labels)
    nearby = np.empty(h * w, np.int32)
    unit = np.empty_like(planes)
    for k in range(len(planes)):
        unit[k] = -planes[k] / max(np.sqrt(dot(planes[k], planes[k])), 1e-12)
    ring = 0
    while len(frontier) > 0:
        m = 0
        for i in frontier:
            r = i // w
            c = i - r * w
            label = out[r, c]
            k = label - 1
            for s, d in ((r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)):
                if s < 0 or s >= h or d < 0 or d >= w or out[s, d] != 0 or rho[s, d] <= 0.0:
                    continue
                p = rho[s, d]
                e = abs(planes[k, 0] * rays_x[d] + planes[k, 1] * rays_y[s] + planes[k, 2] - p) / sigma[s, d]
                if e > gate:
                    continue
                if ring >= reach:
                    facing = normals[s, d, 0] * unit[k, 0] + normals[s, d, 1] * unit[k, 1] + normals[s, d, 2] * unit[k, 2]
                    if facing < cos_cone:
                        continue
                if offered[s, d] == 0:
                    nearby[m] = s * w + d
                    m += 1
                elif e > residual[s, d] or (e == residual[s, d] and label > offered[s, d]):
                    continue
                offered[s, d], residual[s, d] = label, e
        frontier = nearby[:m].copy()
        for i in frontier:
            flat[i] = flat_offered[i]
        ring += 1
    return out


@kernel
def _border(labels: U8) -> I32:
    """Flat numbers of the labelled cells beside unlabelled ones."""
    h, w = labels.shape
    out, n = np.empty(h * w, np.int32), 0
    beside = np.empty(w, np.bool_)
    for r in range(h):
        here, above, below = labels[r], labels[max(r - 1, 0)], labels[min(r + 1, h - 1)]
        for c in range(w):
            beside[c] = (here[c] > 0) & ((above[c] == 0) | (below[c] == 0))
        for c in range(w - 1):
            beside[c] |= (here[c] > 0) & (here[c + 1] == 0)
        for c in range(1, w):
            beside[c] |= (here[c] > 0) & (here[c - 1] == 0)
        for c in range(w):
            if beside[c]:
                out[n] = r * w + c
                n += 1
    return out[:n]


@kernel
def accumulate(labels: U8, regions: int, grid: Grid) -> tuple[F64, F64, F64, I32]:
    """Sums over each region's cells, all of which have depth, weighted by their number of depths: the normal equations of q (k, 3, 3) and (k, 3) with
    `σ = σ_z / z²`, the moments `Σ [x;1][x;1]ᵀ / σ_z²` (k, 4, 4), and the number of depths (k,)."""
    rho, sigma, count, rays_x, rays_y, _ = grid
    sums, n = np.zeros((regions + 1, 19)), np.zeros(regions + 1, np.int32)  # upper triangles of A and M, row by row, and b between them
    h, w = labels.shape
    row = np.empty((5, w))  # x/z, inverse depth, depth and weights
    row[0] = rays_x
    for r in range(h):
        weigh_cells(sigma[r], count[r], row[3])
        for c in range(w):
            p = float(rho[r, c])
            row[1, c], row[2, c], row[4, c] = p, 1.0 / p, row[3, c] * p * p * p * p
        c = 0
        while c < w:
            k, first, depths = labels[r, c], c, 0
            while c < w and labels[r, c] == k:
                c += 1
            if k > 0:
                for readings in count[r, first:c]:
                    depths += readings
                n[k] += depths
                _add_stretch(row[:, first:c], rays_y[r], sums[k])
    A, b, M = np.empty((regions, 3, 3)), sums[1:, 6:9].copy(), np.empty((regions, 4, 4))
    for k in range(regions):
        _symmetric(sums[k + 1, :6], A[k])
        _symmetric(sums[k + 1, 9:], M[k])
    return A, b, M, n[1:].copy()


@kernel
def _add_stretch(columns: F64, y: float, sums: F64) -> None:
    """Add cells beside each other, by x/z, inverse depth, depth and weights (5, n), to the sums (19,) of their region, which do not go through
    memory meanwhile."""
    xs, ps, zs, weights, moments = columns[0], columns[1], columns[2], columns[3], columns[4]
    xx, xy, x1, yy, y1, one, xp, yp, p1 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8]
    XX, XY, XZ, X1, YY, YZ, Y1, ZZ, Z1, ONE = sums[9], sums[10], sums[11], sums[12], sums[13], sums[14], sums[15], sums[16], sums[17], sums[18]
    for c in range(len(xs)):
        x, p, z, weight, moment = xs[c], ps[c], zs[c], weights[c], moments[c]
        px, py = x * z, y * z
        xx, xy, x1 = xx + weight * x * x, xy + weight * x * y, x1 + weight * x
        yy, y1, one = yy + weight * y * y, y1 + weight * y, one + weight
        xp, yp, p1 = xp + weight * x * p, yp + weight * y * p, p1 + weight * p
        XX, XY, XZ, X1 = XX + moment * px * px, XY + moment * px * py, XZ + moment * px * z, X1 + moment * px
        YY, YZ, Y1 = YY + moment * py * py, YZ + moment * py * z, Y1 + moment * py
        ZZ, Z1, ONE = ZZ + moment * z * z, Z1 + moment * z, ONE + moment
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8] = xx, xy, x1, yy, y1, one, xp, yp, p1
    sums[9], sums[10], sums[11], sums[12], sums[13], sums[14], sums[15], sums[16], sums[17], sums[18] = XX, XY, XZ, X1, YY, YZ, Y1, ZZ, Z1, ONE


@kernel
def weigh_cells(sigma: F32, count: U8, out: F64) -> None:
    """Weights (w,) of a row's inverse depths, inf or NaN without any."""
    for c in range(len(out)):
        out[c] = np.int32(count[c]) / (float(sigma[c]) * sigma[c])


@kernel
def _symmetric(upper: F64, out: F64) -> None:
    """Fill a square matrix from its upper triangle, row by row."""
    k = 0
    for i in range(len(out)):
        for j in range(i, len(out)):
            out[i, j] = out[j, i] = upper[k]
            k += 1


@kernel
def areas(labels: U8, count: U8, regions: int) -> I32:
    """(k,) number of depths in each region's cells."""
    out, flat, counts = np.zeros(regions + 1, np.int32), labels.ravel(), count.ravel()
    label, n = 0, 0  # of the stretch of one region: a sum in memory would wait for the one before
    for i in range(len(flat)):
        if flat[i] != label:
            out[label] += n
            label, n = flat[i], 0
        n += counts[i]
    out[label] += n
    return out[1:]


@kernel
def largest_regions(labels: U8, owner: I32, count: U8 | I32, least: int, most: int) -> tuple[U8, U8, I32, I32]:
    """The regions of at least `least` depths, `most` at most, as 1 … k from the largest: `labels` (h, w) by these numbers, 0 = none, the number of
    each label, which of the regions each is, and its number of depths. `owner` (k + 1,) is the region of each label, 0 = none."""
    area, single = np.zeros(len(owner)), areas(labels, count, len(owner) - 1)
    for k in range(1, len(owner)):
        area[owner[k]] += single[k - 1]
    ranked, size, number = np.empty(most, np.int32), np.empty(most, np.int32), np.zeros(len(owner), np.uint8)
    found = 0
    for k in descending(area[1:].copy()):
        if found < most and area[k + 1] >= least:
            ranked[found], size[found], number[k + 1] = k, np.int32(area[k + 1]), found + 1
            found += 1
    number = number[owner]
    out, flat = np.empty(labels.shape, np.uint8), labels.ravel()
    numbered = out.ravel()
    for i in range(len(flat)):
        numbered[i] = number[flat[i]]
    return out, number, ranked[:found].copy(), size[:found].copy()


# Which planar regions are parts of one plane.

NOISE = 7.815  # χ² of a plane's three parameters, 95 %
PARALLEL = 4.0  # times less than the common plane is turned from either must two surfaces be turned from each other to be a step, not a bend


@kernel
def grown_and_merged(
    core: U8, planes: F64, grid: Grid, gate: float, reach: int, cos_cone: float, gap: int, limit: float, alike: float
) -> tuple[U8, I32, tuple[F64, F64, F64, I32]]:
    """Labels (h, w) grown from the `core` of each region as by `grow_regions`, which region each one becomes part of as by `merge_regions` where they
    come within `gap` cells of each other, and the sums over the cores."""
    labels, sums = grow_regions(core, planes, grid, gate, reach, cos_cone), accumulate(core, len(planes), grid)
    return labels, merge_regions(*sums, neighbours(labels, len(planes), gap), limit, alike), sums


@kernel
def neighbours(labels: U8, count: int, gap: int) -> F64:
    """(count, count) number of places where regions lie within `gap` cells of each other in a row or column."""
    h, w = labels.shape
    touch, last = np.zeros((count, count)), np.empty(w, np.bool_)
    for r in range(h):
        here, below = labels[r], labels[min(r + 1, h - 1)]
        for c in range(w):
            last[c] = (here[c] > 0) & (below[c] != here[c])
        for c in range(w - 1):
            last[c] |= (here[c] > 0) & (here[c + 1] != here[c])
        for c in range(w):
            if not last[c]:
                continue
            a = here[c]
            for down, right in ((0, 1), (1, 0)):
                for k in range(1, min(gap, (h - 1 - r) * down + (w - 1 - c) * right) + 1):
                    b = labels[r + k * down, c + k * right]
                    if b == a:
                        break
                    if b > 0:
                        touch[a - 1, b - 1] += 1.0
                        touch[b - 1, a - 1] += 1.0
                        break
    return touch


@kernel
def merge_regions(A: F64, b: F64, moments: F64, n: I32, touch: F64, limit: float, alike: float) -> I32:
    """New label (k + 1,) of each of k regions; the sums (as from `accumulate`, with the neighbours' counts) are added up in place.

    From the largest down a region takes in those smaller neighbours for which the common plane is within `limit` σ (rms) of each one's own, and what
    noise moves these by when `alike` depths err as one."""
    k = len(n)
    sums = A.reshape(k, 9), b, moments.reshape(k, 16), touch
    owner = np.arange(k + 1).astype(np.int32)
    for i in descending(n.astype(np.float64)):
        again = owner[i + 1] == i + 1
        while again:
            again = False
            for j in range(k):
                if touch[i, j] == 0.0 or j == i or owner[j + 1] != j + 1 or n[j] > n[i]:
                    continue
                if not _one_plane(A[i], b[i], n[i], A[j], b[j], n[j], limit, NOISE * alike):
                    continue
                for rows in sums:
                    for c in range(rows.shape[1]):
                        rows[i, c] += rows[j, c]
                n[i] += n[j]
                again = True
                for label in range(k + 1):
                    if owner[label] == j + 1:
                        owner[label] = i + 1
    return owner


@kernel
def _one_plane(A: F64, b: F64, n: int, B: F64, c: F64, m: int, limit: float, noise: float) -> bool:
    """Return True if the common plane of two regions lies within `limit` σ (rms) of each region's own; `noise` is added to the sums of squares. Not
    when it is turned from both while these are parallel: one surface is in front of the other."""
    solved, common = solve_symmetric(A + B, b + c)
    first, p = solve_symmetric(A, b)
    second, q = solve_symmetric(B, c)
    if not (solved and first and second):
        return False
    e, f = common - p, common - q
    turned = min(angle_between(common, p), angle_between(common, q))
    step = turned > LEAST and turned > PARALLEL * angle_between(p, q)
    return not step and dot(e, matvec(A, e)) < limit * limit * n + noise and dot(f, matvec(B, f)) < limit * limit * m + noise


# What is reported of planes beside their labels: coefficients, how these depend on q, how much worse than their noise they are known, samples.

STEP_M = 2.0**-10  # samples of planes say where a plane is, to within centimetres: fewer digits, shorter recordings


@kernel
def plane_report(
    labels: U8, core: U8, number: U8, planes: F64, grid: Grid, tiles: int, expected: float, weight: float, wanted: int, most: int
) -> tuple[F64, F64, F64, F32]:
    """Report planes q (k, 3) with their regions' labels (h, w) and cores, whose labels have these numbers: the coefficients (k, 4), the derivative
    (k, 3, 3) of (a, b, d) by q, the variance (k,) as by `excess_variance` and the samples (k, wanted, 3) as by `spread_samples`."""
    coefficients, J = np.empty((len(planes), 4)), np.empty((len(planes), 3, 3))
    for k in range(len(planes)):
        x, y, z = planes[k, 0], planes[k, 1], planes[k, 2]
        d = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-12)
        coefficients[k, 0], coefficients[k, 1], coefficients[k, 2], coefficients[k, 3] = -x * d, -y * d, -z * d, d
        tangent_columns(coefficients[k], J[k].T)
        for i in range(3):
            J[k, 0, i], J[k, 1, i], J[k, 2, i] = -d * J[k, 0, i], -d * J[k, 1, i], d * d * coefficients[k, i]
    variance = excess_variance(core, number, planes, grid, tiles, expected, weight)
    return coefficients, J, variance, spread_samples(labels, planes, grid.rays_x, grid.rays_y, wanted, most)


@kernel
def spread_samples(labels: U8, planes: F64, rays_x: F64, rays_y: F64, wanted: int, most: int) -> F32:
    """(k, wanted, 3) points of each plane, on its q to half a millimetre, and spread over its region by farthest-point choice among (about) `most`
    cells; NaN-padded."""
    regions = len(planes)
    h, w = labels.shape
    size = _sizes(labels, np.arange(regions + 1).astype(np.uint8), regions)
    out = np.full((regions, wanted, 3), np.nan, np.float32)
    points, used, seen = np.empty((regions, 3, most + 1)), np.zeros(regions, np.int32), np.zeros(regions, np.int32)
    due = np.ceil(0.5 * size / most).astype(np.int32)  # the first of a region's cells, by their number, that is one of `most` spread evenly
    for r in range(h):
        c = 0
        while c < w:
            label, first = labels[r, c], c
            while c < w and labels[r, c] == label:
                c += 1
            if label == 0:
                continue
            k = label - 1
            while due[k] <= seen[k] + c - first and used[k] <= most:
                x, y = rays_x[first + due[k] - seen[k] - 1], rays_y[r]
                p = planes[k, 0] * x + planes[k, 1] * y + planes[k, 2]
                if p > 1e-6:
                    points[k, 0, used[k]], points[k, 1, used[k]], points[k, 2, used[k]] = x / p, y / p, 1.0 / p
                    used[k] += 1
                due[k] = max(due[k] + 1, int(np.ceil((used[k] + 0.5) * size[k] / most)))
            seen[k] += c - first
    for k in range(regions):
        _farthest_points(points[k, 0, : used[k]], points[k, 1, : used[k]], points[k, 2, : used[k]], out[k])
    return out


@kernel
def _farthest_points(xs: F64, ys: F64, zs: F64, out: F32) -> None:
    """Fill the rows of `out`, each the point farthest from those before it, beginning at the middle of the list."""
    n = len(xs)
    distance = np.full(n, np.inf)
    ordered = distance.view(np.int64)  # numbers above 0 are ordered like their bits, and of integers the compiler compares several at once
    chosen = n // 2
    for k in range(min(n, len(out))):
        x, y, z = xs[chosen], ys[chosen], zs[chosen]
        out[k, 0], out[k, 1], out[k, 2] = np.rint(x / STEP_M) * STEP_M, np.rint(y / STEP_M) * STEP_M, np.rint(z / STEP_M) * STEP_M
        for i in range(n):
            e = (xs[i] - x) ** 2 + (ys[i] - y) ** 2 + (zs[i] - z) ** 2
            distance[i] = min(distance[i], e)
        best = ordered[0]
        for i in range(n):
            best = max(best, ordered[i])
        chosen = 0
        while ordered[chosen] < best:
            chosen += 1


@kernel
def _sizes(labels: U8, number: U8, regions: int) -> I32:
    """(k,) number of cells of each region from the labels, whose regions are 1 … k by `number`, 0 = none."""
    out, flat = np.zeros(regions + 1, np.int32), labels.ravel()
    label, first = 0, 0
    for i in range(len(flat)):
        if flat[i] != label:
            out[number[label]] += i - first
            label, first = flat[i], i
    out[number[label]] += len(flat) - first
    return out[1:]


@kernel
def excess_variance(labels: U8, number: U8, planes: F64, grid: Grid, tiles: int, expected: float, weight: float) -> F64:
    """(k,) variance of the mean of a patch of each region over what independent depths with the noise model's σ would give; all its
    cells have depth, and `number` is the region of each label, 0 = none.

    A region is cut into about `tiles` square tiles; with e the residuals and w the weights of a tile's cells the ratio is `Σ (Σ w e)² / Σ Σ w`, for
    the three parameters fitted corrected, and shrunk towards `expected` with the weight of that many tiles. It measures what makes plane fits worse
    than their least-squares covariance: correlated noise, quantisation, lens distortion and surfaces that are not quite plane."""
    rho, sigma, count, rays_x, rays_y, _ = grid
    h, w = labels.shape
    regions = len(planes)
    side = np.maximum(np.sqrt(_sizes(labels, number, regions) / tiles), 2.0)
    across = (w / side).astype(np.int64) + 1
    start = np.zeros(regions + 1, np.int64)
    for k in range(regions):
        start[k + 1] = start[k] + across[k] * (int(h / side[k]) + 1)
    total, information = np.zeros(start[-1] + 1), np.zeros(start[-1] + 1)
    ends = np.empty((regions, w // 2 + 2), np.int32)  # first column after each tile of a row
    for k in range(regions):
        for c in range(w):
            ends[k, int(c / side[k])] = c + 1
    weights = np.empty(w)
    for r in range(h):
        weigh_cells(sigma[r], count[r], weights)
        c = 0
        while c < w:
            label, first = labels[r, c], c
            while c < w and labels[r, c] == label:
                c += 1
            if number[label] == 0:
                continue
            k = number[label] - 1
            u, v, one = planes[k, 0], planes[k, 1], planes[k, 2]
            column, row = int(first / side[k]), start[k] + int(r / side[k]) * across[k]
            while first < c:
                end, t = min(ends[k, column], c), row + column
                residual, inverse, ps, xs, ws = total[t], information[t], rho[r, first:end], rays_x[first:end], weights[first:end]
                for i in range(end - first):
                    residual += ws[i] * (ps[i] - u * xs[i] - v * rays_y[r] - one)
                    inverse += ws[i]
                total[t], information[t] = residual, inverse
                first, column = end, column + 1
    out = np.full(regions, expected)
    for k in range(regions):
        a, b, c = 0.0, 0.0, 0.0
        for t in range(start[k], start[k + 1]):
            a += total[t] * total[t]
            b += information[t]
            c += information[t] * information[t]
        if c > 0.0:
            effective = b * b / c
            out[k] = (a / b * effective + expected * weight) / (max(effective - 3.0, 0.0) + weight)
    return out


# Parallel surfaces a few centimetres apart (a door, a board on a wall) that noise lets pass for one plane, separated by their normals.
#
# The plane fitted to both leans from one to the other by degrees, while the mean of thousands of normals stays that of either: where the two disagree
# the depths are tried as two planes.

LEAST = np.radians(0.4)  # disagreement of normals and plane that is looked into
WIDE, NARROW = np.cos(np.radians([15.0, 8.0]))  # normals further from their mean, then from that of these, are of a patch across a step
SMALLER = 0.5  # the larger of the two planes must disagree by less than this share of what the one did, the smaller by less at all
SHARE = 0.1  # of the cells that the smaller of the two must have
REACH = 2  # cells on each side that distances are averaged over
ROUNDS = 10  # of two means


@kernel
def larger_surface(q: F64, grid: Grid, cells: I32, columns: F64, some: F64, member: Bool) -> tuple[F64, int, F64]:
    """Select, from the members of a region with plane q, when they are two parallel surfaces, the larger one: its q and number of members, which
    alone stay marked, and the q of the other. Otherwise all is left as it is, and there is no other (zeros). `some` of the columns show whether they
    may be."""
    members, none = 0, np.zeros(3)
    for k in range(len(cells)):
        members += member[k]
    normal = _mean_normal(q, some, thinned_marks(member))
    apart = angle_between(q, normal)
    if not apart > LEAST:
        return q, members, none
    further = _further(_distances(normal, grid, cells, member), member)
    one, other = 0, 0
    for k in range(len(cells)):
        one += member[k] and further[k]
        other += member[k] and not further[k]
    if min(one, other) < SHARE * members:
        return q, members, none
    first = _fitted(columns, member & (further == (one >= other)))
    second = _fitted(columns, member & (further != (one >= other)))
    if not (angle_between(first, normal) < SMALLER * apart and angle_between(second, normal) < apart):
        return q, members, none
    for k in range(len(cells)):
        member[k] = member[k] and further[k] == (one >= other)
    return first, max(one, other), second


@kernel
def angle_between(q: F64, normal: F64) -> float:
    """Acute angle (rad) between the normals of two planes, of any length; NaN for no plane or no normal."""
    sine, one, other = 0.0, 0.0, 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        sine += (q[i] * normal[j] - q[j] * normal[i]) ** 2
        one, other = one + q[k] * q[k], other + normal[k] * normal[k]
    squares = one * other
    return float(np.arcsin(min(np.sqrt(sine / squares), 1.0))) if squares > 0.0 else np.nan


@kernel
def _mean_normal(q: F64, columns: F64, member: Bool) -> F64:
    """Unit mean of the normals of the members, those across a step left out; NaN without any."""
    length = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    x, y, z = -q[0] / length, -q[1] / length, -q[2] / length
    inside = np.zeros(len(member), np.bool_)
    for k, least in enumerate((WIDE, NARROW, NARROW)):
        if not mark_within(columns, member, x, y, z, least, inside) and k > 0:
            break  # the same normals as before, and so the same mean
        a, b, c = sum_marked(columns, inside)
        length = np.sqrt(a * a + b * b + c * c)
        x, y, z = a / length, b / length, c / length
    return np.array([x, y, z])


@kernel
def _distances(normal: F64, grid: Grid, cells: I32, member: Bool) -> F64:
    """(n,) how far along the normal the members about each member are from the camera, negative, on average over a square; 0 for the others."""
    w = grid.rho.shape[1]
    top, left, height, width = _box(cells, w)
    sums, counts = np.zeros((height + 1, width + 1)), np.zeros((height + 1, width + 1), np.int32)
    for k in range(len(cells)):
        if member[k]:
            r = cells[k] // w
            c = cells[k] - r * w
            sums[r - top + 1, c - left + 1] = (normal[0] * grid.rays_x[c] + normal[1] * grid.rays_y[r] + normal[2]) / grid.rho[r, c]
            counts[r - top + 1, c - left + 1] = 1
    for r in range(1, height + 1):
        total, n = 0.0, 0
        for c in range(1, width + 1):
            total, n = total + sums[r, c], n + counts[r, c]
            sums[r, c], counts[r, c] = sums[r - 1, c] + total, counts[r - 1, c] + n
    out = np.zeros(len(cells))
    for k in range(len(cells)):
        if member[k]:
            r = cells[k] // w
            r, c = r - top, cells[k] - r * w - left
            a, b, d, e = max(r - REACH, 0), min(r + REACH + 1, height), max(c - REACH, 0), min(c + REACH + 1, width)
            out[k] = (sums[b, e] - sums[a, e] - sums[b, d] + sums[a, d]) / (counts[b, e] - counts[a, e] - counts[b, d] + counts[a, d])
    return out


@kernel
def _box(cells: I32, w: int) -> tuple[int, int, int, int]:
    """Top, left, height and width of the rectangle about cells of a grid of w columns."""
    top, bottom, left, right = cells[0] // w, 0, w, 0
    for i in cells:
        r = i // w
        c = i - r * w
        top, bottom, left, right = min(top, r), max(bottom, r), min(left, c), max(right, c)
    return top, left, bottom - top + 1, right - left + 1


@kernel
def _further(distances: F64, member: Bool) -> Bool:
    """(n,) which members have the further of two distances (two means)."""
    out = np.zeros(len(distances), np.bool_)
    total, square, n = 0.0, 0.0, 0
    for k in range(len(distances)):
        if member[k]:
            n, total, square = n + 1, total + distances[k], square + distances[k] ** 2
    spread = np.sqrt(max(square / n - (total / n) ** 2, 0.0))
    near, far = total / n + spread, total / n - spread
    for _ in range(ROUNDS):
        middle, sums, count, changed = 0.5 * (near + far), 0.0, 0, 0
        for k in range(len(distances)):
            further = distances[k] < middle
            count += further
            changed += further != out[k]
            out[k] = further
        if count == 0 or count == n or changed == 0:
            break
        for k in range(len(distances)):
            sums += distances[k] if out[k] else 0.0
        near, far = (total - sums) / (n - count), sums / count
    return out


@kernel
def _fitted(columns: F64, chosen: Bool) -> F64:
    """q (3,) of the plane through the chosen cells, zeros when there is none."""
    q = np.zeros(3)
    A, b = normal_equations(columns, chosen)
    solve_positive(A.T, b, q)
    return q


# Whether regions found by their depths alone are planes: what the normals of their cells say.


@kernel
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


@kernel
def covariance(products: F64, one: F64, other: F64, count: float) -> F64:
    """(3, 3) from the sums of a bᵀ, a and b over `count` pairs."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = products[i, j] / count - one[i] / count * (other[j] / count)
    return out


@kernel
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


@kernel
def normals_of_regions(labels: I32, planes: F64, grid: Grid, cos_cone: float, step: int) -> tuple[F64, F64, F64]:
    """Statistics of the normals of each region's cells, (k,) each; those within the cone of the region's own count, in every `step`th row and column.

    How far they turn across the region, rad; σ_z over the lesser extent of the region, rad: how far a bias of one σ turns them; and their share."""
    rho, sigma, _, rays_x, rays_y, normals = grid
    h, w = labels.shape
    regions = len(planes)
    cells, facing, error = np.zeros(regions), np.zeros(regions), np.zeros(regions)
    unit, C, D = np.empty((regions, 3)), np.zeros((regions, 3, 3)), np.zeros((regions, 3, 3))
    sum_x, sum_n, x = np.zeros((regions, 3)), np.zeros((regions, 3)), np.empty(3)
    for k in range(regions):
        unit[k] = -planes[k] / max(np.sqrt(dot(planes[k], planes[k])), 1e-12)
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


@kernel
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


# What least squares ask of a region's cells, gathered once: columns side by side, of which the compiler takes several numbers at once.

SOME = 2000  # cells that show where most of a region is


@kernel
def columns_of(grid: Grid, cells: I32) -> F64:
    """(8, n) of the cells, whose numbers ascend: x/z and y/z, inverse depth, its σ, its weight `count / σ²`, and the normal."""
    rho, sigma, count, normals = grid.rho.ravel(), grid.sigma.ravel(), grid.count.ravel(), grid.normals.reshape(-1, 3)
    out, w = np.empty((8, len(cells))), len(grid.rays_x)
    r = 0
    for k in range(len(cells)):
        i = cells[k]
        while i >= (r + 1) * w:
            r += 1
        out[0, k], out[1, k], out[2, k], out[3, k] = grid.rays_x[i - r * w], grid.rays_y[r], rho[i], sigma[i]
        out[4, k], out[5, k], out[6, k], out[7, k] = np.int32(count[i]) / (sigma[i] * sigma[i]), normals[i, 0], normals[i, 1], normals[i, 2]
    return out


@kernel
def thinned(columns: F64) -> F64:
    """One cell in as many as leave at least SOME."""
    step = max(columns.shape[1] // SOME, 1)
    if step == 1:
        return columns
    out = np.empty((8, (columns.shape[1] + step - 1) // step))
    for j in range(8):
        for k in range(out.shape[1]):
            out[j, k] = columns[j, k * step]
    return out


@kernel
def thinned_marks(marks: Bool) -> Bool:
    """The marks (n,) of the cells that `thinned` leaves."""
    return marks[:: max(len(marks) // SOME, 1)].copy()


@kernel
def normal_equations(columns: F64, chosen: Bool) -> tuple[F64, F64]:
    """Normal equations of q, from the weighted depths of the chosen cells: A (3, 3), of which only the upper triangle is filled, and b (3,)."""
    xs, ys, rho, weights = columns[0], columns[1], columns[2], columns[4]
    xx, xy, x1, yy, y1, one, xp, yp, p1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(chosen)):
        x, y, p, weight = xs[k], ys[k], rho[k], weights[k] if chosen[k] else 0.0
        xx, xy, x1 = xx + weight * x * x, xy + weight * x * y, x1 + weight * x
        yy, y1, one = yy + weight * y * y, y1 + weight * y, one + weight
        xp, yp, p1 = xp + weight * x * p, yp + weight * y * p, p1 + weight * p
    A, b = np.zeros((3, 3)), np.empty(3)
    A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2] = xx, xy, x1, yy, y1, one
    b[0], b[1], b[2] = xp, yp, p1
    return A, b


@kernel
def mark_within(columns: F64, chosen: Bool, x: float, y: float, z: float, least: float, inside: Bool) -> bool:
    """Mark the chosen cells whose normal's cosine with (x, y, z) is above `least`; whether these are others than were marked."""
    nx, ny, nz = columns[5], columns[6], columns[7]
    changed = 0
    for k in range(len(inside)):
        counts = chosen[k] & (nx[k] * x + ny[k] * y + nz[k] * z > least)
        changed += counts != inside[k]
        inside[k] = counts
    return changed > 0


@kernel
def sum_marked(columns: F64, inside: Bool) -> tuple[float, float, float]:
    """Sum of the normals of the marked cells."""
    nx, ny, nz = columns[5], columns[6], columns[7]
    a, b, c = 0.0, 0.0, 0.0
    for k in range(len(inside)):
        a, b, c = a + (nx[k] if inside[k] else 0.0), b + (ny[k] if inside[k] else 0.0), c + (nz[k] if inside[k] else 0.0)
    return a, b, c
