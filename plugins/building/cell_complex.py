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

FREE_SHARE = 0.5  # of a cell, for which it may be inside
TALL_SHARE = 0.5  # of an edge between cells, for which it parts them


@dataclass(frozen=True)
class Cells:
    """The cells of an arrangement: polygons, the share of each that is free, whether any of it was seen, and the edges (a, b, tall share, length)
    between neighbours."""

    polygons: list[Any]
    free: F64
    edges: list[tuple[int, int, float, float]]


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
    for face in faces:
        foot = middle + (face.offset_m - matmul(middle, face.normal)) * face.normal
        lines.append(shapely.LineString([foot - reach * face.along, foot + reach * face.along]).intersection(box))
    polygons = list(polygonize(unary_union(shapely.set_precision(lines, 1e-5))))
    free = np.array([_free_share(polygon, space) for polygon in polygons])
    sides: dict[tuple[tuple[float, float], tuple[float, float]], list[int]] = defaultdict(list)
    for number, polygon in enumerate(polygons):
        ring = [tuple(np.round(p, 4)) for p in polygon.exterior.coords]
        for p, q in pairwise(ring):
            if p != q:
                sides[min(p, q), max(p, q)].append(number)
    edges = []
    for (p, q), pair in sides.items():
        if len(pair) == 2:
            a, b = np.array(p), np.array(q)
            edges.append((pair[0], pair[1], _tall_share(faces, a, b), float(norm(b - a))))
    return Cells(polygons, free, edges)


def _free_share(polygon: Any, space: FreeSpace) -> float:
    """Return the share of a cell that rays passed."""
    import shapely

    x0, y0, x1, y1 = polygon.bounds
    grid = np.stack(np.meshgrid(_steps(x0, x1), _steps(y0, y1)), axis=-1).reshape(-1, 2)
    inside = grid[shapely.contains_xy(polygon, grid[:, 0], grid[:, 1])]
    if len(inside) == 0:
        inside = np.array([polygon.representative_point().coords[0]])
    return float((space.at(inside) != 0).mean())


def _steps(low: float, high: float) -> F64:
    count = max(int((high - low) / CELL_M), 2)
    return low + (np.arange(count) + 0.5) * (high - low) / count


def _tall_share(faces: list[Face], a: F64, b: F64) -> float:
    """Return the greatest share of a stretch that one face covers with tall columns."""
    direction = (b - a) / max(float(norm(b - a)), 1e-9)
    best = 0.0
    for face in faces:
        if abs(float(matmul(direction, face.normal))) < 0.02 and abs(float(matmul(a + b, face.normal)) / 2.0 - face.offset_m) < 0.02:
            t0, t1 = sorted((float(matmul(a, face.along)), float(matmul(b, face.along))))
            best = max(best, face.share(t0, t1, face.tall))
    return best


def free_cells(cells: Cells) -> Bool:
    """Return the cells (n,) that are inside: those that rays passed."""
    return np.asarray(cells.free >= FREE_SHARE, np.bool_)


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
