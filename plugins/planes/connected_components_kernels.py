"""Numba kernels of `connected_components.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8
from trihedron.plugins.planes.curvature_kernels import angle_across
from trihedron.plugins.planes.parallel_surfaces_kernels import larger_surface
from trihedron.plugins.planes.region_cells_kernels import gather_cells, subsample, subsample_marks
from trihedron.plugins.planes.trimmed_fit_kernels import fit_component
from trihedron.plugins.shared.depth_image_kernels import Grid, cells_by_component, coarser, connected_components, smooth_links


@kernel
def planar_components(
    grid: Grid, edge: tuple[float, float], angle: float, gate: float, cone: float, turn: float, rounds: int, least: int, most: int
) -> tuple[U8, F64]:
    """Labels (h, w) of the cells that make up each plane, 0 = none, and the planes' q (k, 3), `most` at most.

    Components of `least` cells or more, whose normals differ from their neighbours' by less than `angle` (rad), are sought on cells of twice the size
    (a quarter of the work) without a step of more than `edge` (share of z, and m), and again among what is left: `rounds` times, with half the `cone`
    (rad) in each further round. The normals of a plane lie within the cone and turn by no more than `turn` cones."""
    coarse = coarser(grid, edge[0], edge[1])
    h, w = coarse.rho.shape
    labels, planes = np.zeros((h, w), np.uint8), np.zeros((most, 3))
    found, before = np.int64(0), np.int64(-1)  # as literals, numba would compile `fit_components` for them, too
    links, free = smooth_links(coarse, np.cos(angle), gate), np.empty((h, w), np.bool_)
    cells, starts = np.empty(0, np.int32), np.zeros(1, np.int32)
    for _ in range(rounds):
        if found > before:
            for r in range(h):
                for c in range(w):
                    free[r, c] = (coarse.rho[r, c] > 0.0) & (coarse.normals[r, c, 0] == coarse.normals[r, c, 0]) & (labels[r, c] == 0)
            cells, starts = cells_by_component(connected_components(links, free), least)
        before = found
        found = fit_components(coarse, cells, starts, cone, gate, turn * cone, least, labels, planes, found)
        cone /= 2.0
    return _finer(labels, grid.rho), planes[:found]


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
        columns, member = gather_cells(grid, component), np.zeros(len(component), np.bool_)
        sample = subsample(columns)
        q, members = fit_component(columns, sample, np.cos(cone), gate, member)
        q, members, _ = larger_surface(q, grid, component, columns, sample, member)
        if members < least or angle_across(q, sample, subsample_marks(member)) > curved:
            continue
        planes[found, 0], planes[found, 1], planes[found, 2] = q[0], q[1], q[2]
        found += 1
        for i in range(len(component)):
            if member[i]:
                flat[component[i]] = found
    return found


@kernel
def _finer(labels: U8, rho: F32) -> U8:
    """Labels (h, w) of cells by those of cells of twice the size; 0 without depth."""
    h, w = rho.shape
    out, wide = np.empty((h, w), np.uint8), np.empty(2 * labels.shape[1], np.uint8)
    for r in range(h):
        if r % 2 == 0:
            for c in range(labels.shape[1]):
                wide[2 * c] = wide[2 * c + 1] = labels[r // 2, c]
        for c in range(w):
            out[r, c] = wide[c] if rho[r, c] > 0.0 else 0
    return out
