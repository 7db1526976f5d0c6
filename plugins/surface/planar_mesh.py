"""Planes as polygons: the planar parts of a dense mesh on their planes, simplified, cut into few triangles, and joined to what is beside them.

The meshing of the paper (section V-B) is `planar_greedy.py`."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Map, Surface
from trihedron.plugins.surface.colored_mesh import map_planes, number_planes, textured_surface
from trihedron.plugins.surface.decimation import decimate
from trihedron.plugins.surface.fused_volume import FusedViews, final_mesh
from trihedron.plugins.surface.half_edges import non_manifold_half_edges, opposite_half_edges, split_fans, vertex_normals
from trihedron.plugins.surface.half_edges_kernels import triangle_components, triangle_normals
from trihedron.plugins.surface.outlines import REST, border_half_edges, border_vertices, close_pinholes, fixed_vertices
from trihedron.plugins.surface.outlines_kernels import loops
from trihedron.plugins.surface.planar_segmentation import PlanarOptions, planar_labels
from trihedron.plugins.surface.plane_axes import plane_axes
from trihedron.plugins.surface.plane_snapping import snap_to_planes


def planar_surface(options: PlanarOptions, state: FusedViews, map: Map | None, rest: bool) -> Surface:
    """The planes of the map and others in the mesh of all views, as polygons; with `rest` the triangles that lie in none stay, joined to them."""
    vertices, triangles = final_mesh(options, state, map)
    opposite = opposite_half_edges(triangles)
    ids, known = map_planes(map)
    labels, planes = planar_labels(vertices, vertex_normals(vertices, triangles), triangles, opposite, known, options)
    if not rest:
        vertices, triangles = split_fans(vertices, triangles[labels >= 0])
        labels = labels[labels >= 0]
        opposite = opposite_half_edges(triangles)
    flat = flatten(options, vertices, triangles, opposite, labels, planes)
    shown = flat.labels >= (REST if rest else 0)
    triangles, labels = close_pinholes(flat.vertices, flat.triangles[shown], flat.labels[shown])
    return textured_surface(state, map, flat.vertices, triangles, labels, planes, number_planes(ids, len(planes), map), flat.loops, options.texel_m)


# The planar parts of a mesh as polygons: their loops simplified, cut into few triangles, and joined to what is beside them vertex by vertex.


@dataclass(frozen=True)
class FlatMesh:
    """A mesh (vertices (v, 3), some unused; triangles (t, 3)) with the plane of each triangle (t,), -1 = none, and the loops of the parts: (plane,
    vertices round it), as `types.Surface`."""

    vertices: F64
    triangles: I32
    labels: I32
    loops: list[tuple[int, I32]]


def flatten(options: PlanarOptions, vertices: F64, triangles: I32, opposite: I32, labels: I32, planes: F64) -> FlatMesh:
    """The mesh with each planar part on its plane and cut into few triangles, its outline within the tolerance. Where parts touch they share
    vertices: on the line where their planes meet, and along the triangles of no plane all of them."""
    if not (labels >= 0).any():
        return FlatMesh(vertices, triangles, labels, [])
    points = snap_to_planes(vertices, triangles, labels, planes, options.snap_m)
    parts, _ = triangle_components(opposite, labels)
    parts = np.where(labels >= 0, parts, REST).astype(np.int32)
    border = border_half_edges(parts, opposite)
    fixed = fixed_vertices(len(vertices), triangles, parts, opposite)
    keep, beside = border_vertices(points, triangles, parts, opposite, border, fixed, options.outline_m)
    on_border = np.zeros(len(vertices), np.bool_)
    for ends in (triangles, triangles[:, [1, 2, 0]]):
        on_border[ends.ravel()[border]] = True
    triangles = triangles.copy()
    rows = decimate(points, triangles, labels, planes, on_border | fixed, on_border & ~keep & ~fixed, beside)
    triangles, labels, parts = triangles[rows], labels[rows], parts[rows]
    return _recut(points, triangles, labels, parts, planes, options.hole_m2)


def _recut(points: F64, triangles: I32, labels: I32, parts: I32, planes: F64, hole_m2: float) -> FlatMesh:
    """Each part whose outline does not cross itself as the Delaunay triangulation of its polygon, unless that joins two vertices which are joined
    beside it already. Holes in the mesh of less than `hole_m2` are closed. What is folded over for good belongs to no plane."""
    opposite = opposite_half_edges(triangles)
    order, starts = loops(border_half_edges(parts, opposite), parts, opposite)
    rings: dict[int, list[I32]] = {}
    holes: dict[int, list[I32]] = {}
    for a, b in pairwise(starts):
        ring = triangles.ravel()[order[a:b]]
        closed = (opposite[order[a:b]] < 0).all() and 0.0 < -_area(matmul(points[ring], plane_axes(planes[labels[order[a] // 3]]))) < hole_m2
        (holes if closed else rings).setdefault(int(parts[order[a] // 3]), []).append(ring)
    first = {part: int(row) for part, row in zip(*np.unique(parts, return_index=True)) if part != REST}
    cuts = {part: found for part, row in first.items() if (found := _cut(points, rings[part], planes[labels[row]])) is not None}
    while True:
        stay = ~np.isin(parts, list(cuts))
        whole = np.concatenate([triangles[stay], *cuts.values()]).astype(np.int32)
        owners = np.concatenate([parts[stay], *(np.full(len(found), part, np.int32) for part, found in cuts.items())])
        doubled = set(owners[non_manifold_half_edges(whole, opposite_half_edges(whole)) // 3].tolist()) & set(cuts)
        if not doubled:
            break
        cuts = {part: found for part, found in cuts.items() if part not in doubled}
    outlines = [(part, ring) for part in first for ring in rings[part] + (holes.get(part, []) if part not in cuts else [])]
    plane_of = np.full(parts.max() + 2, REST, np.int32)  # the last is that of the rest
    plane_of[parts] = labels
    found = plane_of[owners]
    backwards = np.einsum("ij,ij->i", triangle_normals(points, whole), np.append(planes, np.zeros((1, 4)), axis=0)[found, :3]) < 0.0
    found[backwards] = REST
    return FlatMesh(points, whole, found, [(int(plane_of[part]), ring) for part, ring in outlines])


def _cut(points: F64, rings: list[I32], plane: F64) -> I32 | None:
    """Triangles (t, 3) of the polygon with these loops, a constrained Delaunay triangulation; None when they cross or touch."""
    import shapely

    flat = [matmul(points[ring], plane_axes(plane)) for ring in rings]
    turned = np.array([_area(ring) for ring in flat])
    outer = int(np.argmax(turned))
    if turned[outer] <= 0.0 or (turned > 0.0).sum() > 1 or min(map(len, rings)) < 3:
        return None
    polygon = shapely.Polygon(flat[outer], [ring for k, ring in enumerate(flat) if k != outer])
    if not polygon.is_valid:
        return None
    corners = shapely.get_coordinates(shapely.constrained_delaunay_triangles(polygon)).reshape(-1, 4, 2)[:, :3]
    found = _vertex_numbers(corners.reshape(-1, 2), np.concatenate(flat), np.concatenate(rings))
    triangles = found.reshape(-1, 3) if found is not None else None
    if triangles is None:
        return None
    area = np.array([_area(corner) for corner in corners])
    return np.where(area[:, None] > 0.0, triangles, triangles[:, ::-1]).astype(np.int32)


def _area(ring: F64) -> float:
    """Signed area of a polygon (n, 2), positive when anticlockwise."""
    following = np.roll(ring, -1, axis=0)
    return float(0.5 * (ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]).sum())


def _vertex_numbers(corners: F64, flat: F64, numbers: I32) -> I32 | None:
    """The number of each corner (n, 2), by its exact coordinates among `flat` (m, 2); None when one is new."""
    order = np.lexsort((flat[:, 1], flat[:, 0]))
    keys, wanted = (np.ascontiguousarray(a).view([("x", "f8"), ("y", "f8")]).ravel() for a in (flat[order], corners))
    rows = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return numbers[order][rows] if (keys[rows] == wanted).all() else None
