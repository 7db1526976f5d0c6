"""Numba kernels of `ransac.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot
from trihedron.pipeline.core.types import F64, I32, U8, Bool
from trihedron.plugins.planes.region_cells_kernels import gather_cells
from trihedron.plugins.planes.trimmed_fit_kernels import fit_cells
from trihedron.plugins.shared.depth_image_kernels import Grid, cells_by_component, connected_components

# Sequential RANSAC of planes on an organised grid (Fischler and Bolles 1981), each plane a connected region of inliers.

SCORED = 800  # cells a hypothesis is scored on, spread over those that are left
POLISH = 3  # rounds of least squares on the inliers and of finding them again


@kernel
def consensus_planes(grid: Grid, draws: F64, gate: float, cos_cone: float, least: int, misses: int) -> tuple[I32, F64]:
    """Labels (h, w) of the cells, 0 = none, and q (k, 3) of their planes, in the order found.

    `draws` (rounds, hypotheses, 7) are uniform in [0, 1). A round takes the best of its hypotheses, each the plane through three cells not far from
    each other, by the truncated squared error (MSAC, Torr & Zisserman 2000) of the cells that are left, fits it to its inliers (within `gate` σ_z
    and with a normal, where there is one, within the cone) and takes the largest connected region of them away: a plane if it has `least` cells.
    After `misses` regions in a row that are too small there is no more to be found."""
    h, w = grid.rho.shape
    labels, planes, found, missed = np.zeros((h, w), np.int32), np.zeros((len(draws), 3)), 0, 0
    free, links = grid.rho > 0.0, _all_links(h, w)
    for turn in range(len(draws)):
        cells = np.flatnonzero(free).astype(np.int32)
        if len(cells) < least or missed >= misses:
            break
        q = _best_hypothesis(grid, draws[turn], cells, free, gate, cos_cone)
        region = cells[:0]
        for _ in range(POLISH):
            if not q.any():
                break
            region = _connected_inliers(grid, q, cells, links, gate, cos_cone)
            member = np.zeros(len(region), np.bool_)
            q, _ = fit_cells(q, gather_cells(grid, region), cos_cone, gate, member)
        accepted = len(region) >= least and q.any()
        if accepted:
            planes[found] = q
            found += 1
        missed = 0 if accepted else missed + 1
        for i in region:
            free[i // w, i % w] = False
            if accepted:
                labels[i // w, i % w] = found
    return labels, planes[:found]


@kernel
def _all_links(h: int, w: int) -> U8:
    """The links of `connected_components` between all neighbours."""
    links = np.full((h, w), 3, np.uint8)
    links[0, :], links[:, 0] = 1, 2
    links[0, 0] = 0
    return links


@kernel
def _best_hypothesis(grid: Grid, draws: F64, cells: I32, free: Bool, gate: float, cos_cone: float) -> F64:
    """q of the best of the planes drawn; zeros when none could be."""
    best, most = np.zeros(3), 0.0
    some = cells[:: max(len(cells) // SCORED, 1)].copy()
    for k in range(len(draws)):
        q = _hypothesis(grid, draws[k], cells, free)
        if not q.any():
            continue
        score = _score(grid, q, some, gate, cos_cone)
        if score > most:
            best, most = q, score
    return best


@kernel
def _hypothesis(grid: Grid, draw: F64, cells: I32, free: Bool) -> F64:
    """q of the plane through a cell and two free ones within a square around it, whose size is drawn too; zeros when there is none."""
    h, w = free.shape
    radius = 2.0 + 0.15 * w * draw[6]
    A, b = np.empty((3, 3)), np.empty(3)
    first = cells[int(draw[0] * len(cells))]
    for k in range(3):
        r, c = first // w, first % w
        if k > 0:
            r += int(np.rint((2.0 * draw[2 * k - 1] - 1.0) * radius))
            c += int(np.rint((2.0 * draw[2 * k] - 1.0) * radius))
            if r < 0 or r >= h or c < 0 or c >= w or not free[r, c]:
                return np.zeros(3)
        A[k, 0], A[k, 1], A[k, 2], b[k] = grid.rays_x[c], grid.rays_y[r], 1.0, grid.rho[r, c]
    x1, y1, x2, y2 = A[1, 0] - A[0, 0], A[1, 1] - A[0, 1], A[2, 0] - A[0, 0], A[2, 1] - A[0, 1]
    det = x1 * y2 - x2 * y1
    q = np.zeros(3)
    if not abs(det) > 0.1 * (x1 * x1 + y1 * y1 + x2 * x2 + y2 * y2):  # a sliver, or one cell twice
        return q
    q[0], q[1] = (y2 * (b[1] - b[0]) - y1 * (b[2] - b[0])) / det, (x1 * (b[2] - b[0]) - x2 * (b[1] - b[0])) / det
    q[2] = b[0] - q[0] * A[0, 0] - q[1] * A[0, 1]
    return q


@kernel
def _score(grid: Grid, q: F64, cells: I32, gate: float, cos_cone: float) -> float:
    """Sum over the cells of 1 - (e / gate)², 0 for outliers; e in σ_z."""
    w = grid.rho.shape[1]
    length = np.sqrt(dot(q, q))
    nx, ny, nz = -q[0] / length, -q[1] / length, -q[2] / length
    total = 0.0
    for i in cells:
        r, c = i // w, i % w
        e = (q[0] * grid.rays_x[c] + q[1] * grid.rays_y[r] + q[2] - grid.rho[r, c]) / (gate * grid.sigma[r, c])
        if e * e < 1.0 and not grid.normals[r, c, 0] * nx + grid.normals[r, c, 1] * ny + grid.normals[r, c, 2] * nz < cos_cone:
            total += 1.0 - e * e
    return total


@kernel
def _connected_inliers(grid: Grid, q: F64, cells: I32, links: U8, gate: float, cos_cone: float) -> I32:
    """The largest connected region of inliers among the cells."""
    member, inlier = np.zeros(len(cells), np.bool_), np.zeros(grid.rho.shape, np.bool_)
    fit_cells(q, gather_cells(grid, cells), cos_cone, gate, member)
    w = grid.rho.shape[1]
    for k in range(len(cells)):
        if member[k]:
            inlier[cells[k] // w, cells[k] % w] = True
    regions, starts = cells_by_component(connected_components(links, inlier), 1)
    return regions[: starts[1]] if len(starts) > 1 else cells[:0]
