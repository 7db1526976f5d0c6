"""The lines of all faces divide the plan into cells; those that rays passed are inside, and tall faces part rooms."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.building.faces import Face
from trihedron.plugins.building.free_space import CELL_M, FreeSpace
from trihedron.plugins.building.jogs import THICKEST_M, parting_columns

OPEN_BORDER_M = 0.15  # area in m² that a metre of border without a wall costs
UNSEEN = 0.25  # of the area of a cell that no ray passed, which counts against its being inside
WIDE_M2 = 2.0  # cell, of which all of it does: nobody overlooks so much of a room
THIN_M = 0.38  # width of a cell that may be within a wall
CAPACITY = 10_000  # of a square metre: capacities are whole numbers
SLIVER_M = 0.005  # between lines that are one
ON_LINE_M, LEAST_COSINE = 0.02, 0.9998  # of a stretch on the line of a face
OPPOSITE_M = 0.6  # of the two faces of a wall
TALL_SHARE = 0.5  # of an edge between cells, for which it parts them


@dataclass(frozen=True)
class Cells:
    """The cells of an arrangement: polygons, the share of each that is free, the edges (a, b, tall share, length) between neighbours, and which cells
    (n,) may be within a wall: behind a face, or between the lines of both faces of one."""

    polygons: list[Any]
    free: F64
    edges: list[tuple[int, int, float, float]]
    in_wall: Bool


def cells_of(faces: list[Face], space: FreeSpace) -> Cells:
    """Cut the plan along the lines of all faces, and ask free space of each cell and the faces of each edge between two."""
    import shapely
    from shapely.ops import polygonize, unary_union

    h, w = space.levels.shape
    low, high = space.origin, space.origin + CELL_M * np.array([w, h])
    box = shapely.box(*low, *high)
    reach = float(norm(high - low))
    middle = (low + high) / 2.0
    lines = [box.exterior]
    for number, face in enumerate(faces):
        if any(_is_one_line(face, other) for other in faces[:number]):
            continue
        foot = middle + (face.offset_m - matmul(middle, face.normal)) * face.normal
        lines.append(shapely.LineString([foot - reach * face.along, foot + reach * face.along]).intersection(box))
    polygons = [shapely.geometry.polygon.orient(polygon) for polygon in polygonize(unary_union(shapely.set_precision(lines, 1e-5)))]
    free = np.array([_free_share(polygon, space) for polygon in polygons])
    sides: dict[tuple[tuple[float, float], tuple[float, float]], list[tuple[int, float]]] = defaultdict(list)
    for number, polygon in enumerate(polygons):
        ring = [tuple(np.round(p, 4)) for p in polygon.exterior.coords]
        for p, q in pairwise(ring):
            if p != q:
                sides[min(p, q), max(p, q)].append((number, 1.0 if p < q else -1.0))
    edges, in_wall = [], _are_between(polygons, faces)
    parting, normals = [(face, parting_columns(face, faces)) for face in faces], np.array([face.normal for face in faces]).reshape(-1, 2)
    for (p, q), pair in sides.items():
        if len(pair) == 2:
            a, b = np.array(p), np.array(q)
            along = _faces_along(parting, normals, a, b)
            edges.append((pair[0][0], pair[1][0], _tall_share(along), float(norm(b - a))))
            for number, left in pair:
                in_wall[number] |= any(side == -left and abs(at) < ON_LINE_M and share >= TALL_SHARE for side, at, share in along)
    return Cells(polygons, free, edges, in_wall)


def _are_between(polygons: list[Any], faces: list[Face]) -> Bool:
    """Say of each polygon (n,) if it is between the lines of the two faces of a wall, of which a stretch is seen from both sides."""
    places = np.array([polygon.representative_point().coords[0] for polygon in polygons]).reshape(-1, 2)
    between = np.zeros(len(places), np.bool_)
    for face in faces:
        across = matmul(places, face.normal)
        for other in faces:
            if _are_of_one_wall(face, other):
                between |= (-other.offset_m < across) & (across < face.offset_m)
    return between


def _are_of_one_wall(face: Face, other: Face) -> bool:
    """Say if two faces look away from each other, less than a wall's thickness apart, and a long stretch of both is opposite."""
    if float(matmul(face.normal, other.normal)) > -0.999 or not 0.0 < face.offset_m + other.offset_m < THICKEST_M:
        return False
    places = -(face.start_m + (np.nonzero(face.tall)[0] + 0.5) * CELL_M)
    columns = np.floor((places - other.start_m) / CELL_M).astype(int)
    columns = columns[(columns >= 0) & (columns < len(other.tall))]
    return float(other.tall[columns].sum()) * CELL_M >= OPPOSITE_M


def _is_one_line(face: Face, other: Face) -> bool:
    """Say if the lines of two faces, whichever way they look, are one but for a sliver."""
    side = float(matmul(face.normal, other.normal))
    return abs(side) > 1.0 - 1e-6 and abs(face.offset_m - np.sign(side) * other.offset_m) < SLIVER_M


def _free_share(polygon: Any, space: FreeSpace) -> float:
    """Return the share of a cell that rays passed."""
    import shapely

    x0, y0, x1, y1 = polygon.bounds
    grid = np.stack(np.meshgrid(_steps(x0, x1), _steps(y0, y1)), axis=-1).reshape(-1, 2)
    inside = grid[shapely.contains_xy(polygon, grid[:, 0], grid[:, 1])]
    if len(inside) == 0:
        inside = np.array([polygon.representative_point().coords[0]])
    return float(space.within(inside).mean())


def _steps(low: float, high: float) -> F64:
    count = max(int((high - low) / CELL_M), 2)
    return low + (np.arange(count) + 0.5) * (high - low) / count


def _faces_along(parting: list[tuple[Face, Bool]], normals: F64, a: F64, b: F64) -> list[tuple[float, float, float]]:
    """Return of each face on or near a stretch the side that it looks to (1 = left), how far left of the stretch it is, and the share of the stretch
    that its parting columns cover. `normals` (f, 2) are those of the faces."""
    direction, middle = (b - a) / max(float(norm(b - a)), 1e-9), (a + b) / 2.0
    across = np.array([-direction[1], direction[0]])
    sides, where = matmul(normals, across), float(matmul(middle, across))
    faces = []
    for number in np.nonzero(np.abs(sides) > LEAST_COSINE)[0]:
        (face, columns), side = parting[number], float(np.sign(sides[number]))
        at = side * face.offset_m - where
        if abs(at) < THICKEST_M:
            t0, t1 = sorted((float(matmul(a, face.along)), float(matmul(b, face.along))))
            faces.append((side, at, face.share(t0, t1, columns)))
    return faces


def _tall_share(faces: list[tuple[float, float, float]]) -> float:
    """Return the greatest share of a stretch that one of the faces along it covers: one on its line, or the other face of the wall whose face is on
    its line elsewhere."""
    best = max((share for _, at, share in faces if abs(at) < ON_LINE_M), default=0.0)
    for side in {side for side, at, _ in faces if abs(at) < ON_LINE_M}:
        behind = [(-side * at, share) for other, at, share in faces if other == -side and ON_LINE_M < -side * at < THICKEST_M]
        nearer = [-side * at for other, at, share in faces if other == side and share > 0.0 and -side * at > ON_LINE_M]
        best = max([best, *(share for depth, share in behind if not any(at < depth for at in nearer))])
    return best


def inside_cells(cells: Cells) -> Bool:
    """Return the cells (n,) that are inside: those that rays passed, and with them what was not seen and no wall parts from them. What may be
    within a wall, and is as thin as one, is solid where no ray passed, and has no open border there."""
    thin = np.array([polygon.buffer(-THIN_M / 2.0).is_empty for polygon in cells.polygons])
    wide = np.array([polygon.area > WIDE_M2 for polygon in cells.polygons])
    solid = thin & cells.in_wall
    return cut_cells(cells, OPEN_BORDER_M * np.where(solid, cells.free, 1.0), np.where(solid | wide, 1.0, UNSEEN))


def cut_cells(cells: Cells, open_border_m: F64 | float, unseen: F64 | float) -> Bool:
    """Label the cells (n,) inside or outside together, by a minimum cut source - cells - sink (Boykov, Jolly, ICCV 2001): a cell that is outside
    costs the area that rays passed, m²; one that is inside costs `unseen` times the area that they did not; a metre of border between both without a
    wall costs `open_border_m`, the lesser of both cells'."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    n = len(cells.polygons)
    area = np.array([polygon.area for polygon in cells.polygons])
    first, second, tall, length = np.array(cells.edges).reshape(-1, 4).T
    numbers, open_border = np.arange(n), np.broadcast_to(open_border_m, n)
    border = np.minimum(open_border[first.astype(int)], open_border[second.astype(int)]) * length * (1.0 - tall)
    rows = np.concatenate([np.full(n, n), numbers, first, second]).astype(int)
    columns = np.concatenate([numbers, np.full(n, n + 1), second, first]).astype(int)
    capacity = np.concatenate([area * cells.free, unseen * area * (1.0 - cells.free), border, border])
    graph = coo_matrix((np.rint(CAPACITY * capacity).astype(np.int32), (rows, columns)), shape=(n + 2, n + 2)).tocsr()
    residual = graph - maximum_flow(graph, n, n + 1).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    inside = np.zeros(n + 2, np.bool_)
    inside[breadth_first_order(residual, n, return_predecessors=False)] = True
    return np.asarray(inside[:n], np.bool_)


def components(cells: Cells, inside: Bool) -> list[I32]:
    """Join inside cells that no tall face parts; the largest first."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    kept = [(a, b) for a, b, tall, _ in cells.edges if inside[a] and inside[b] and tall < TALL_SHARE]
    pairs = np.array(kept, int).reshape(-1, 2)
    n = len(cells.polygons)
    _, labels = connected_components(coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n)), directed=False)
    groups = [np.nonzero((labels == label) & inside)[0].astype(np.int32) for label in np.unique(labels[inside])]
    return sorted(groups, key=lambda group: -sum(cells.polygons[k].area for k in group))
