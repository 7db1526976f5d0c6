"""Shared parts of the planar meshes: a dense mesh, and the part of it that lies in planes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import AcuteDeg, NonNegativeFloat, NonNegativeInt, PositiveFloat, Range, check_increasing
from trihedron.pipeline.core.types import F64, I32, Map, Surface
from trihedron.plugins.surface.common import map_planes, numbered, pictured
from trihedron.plugins.surface.common_iso_surface import Fused, VolumeOptions, final_mesh
from trihedron.plugins.surface.common_meshes import (
    REST,
    border_half_edges,
    crowded,
    decimated,
    fixed_vertices,
    kept_vertices,
    opposite_half_edges,
    plane_axes,
    triangle_areas,
    vertex_normals,
    with_single_fans,
    without_pinholes,
)
from trihedron.plugins.surface.common_meshes_kernels import connected, loops, triangle_normals
from trihedron.plugins.surface.common_planar_kernels import (
    bends_kernel,
    enclosing,
    grown_kernel,
    on_planes,
    plane_through,
    planes_about,
    snapped_kernel,
    steadiness,
    unfold,
    with_rim,
    without_steps,
)


@dataclass(frozen=True)
class PlanarOptions(VolumeOptions):
    """Options of planes as polygons: those of the volume, and what is flat in its mesh."""

    distance_m: PositiveFloat = 0.012  # of a vertex from its plane
    angle_deg: AcuteDeg = 25.0  # between the mesh's normal there and the plane's
    rim_m: PositiveFloat = 0.03  # of a vertex from its plane in the rounded rim about it
    rim: NonNegativeInt = 4  # triangles wide
    area_m2: PositiveFloat = 0.02  # of the smallest planar part
    bend_per_m: PositiveFloat = 0.8  # curvature above which a part is not flat
    snap_m: PositiveFloat = 0.05  # how far a vertex may be moved onto the line or the point where planes meet
    outline_m: NonNegativeFloat = 0.02  # error allowed to an outline
    hole_m2: NonNegativeFloat = 0.01  # a hole in a plane's mesh, with nothing in it, that is smaller is closed
    texel_m: Annotated[float, Range(0.001)] = 0.015  # of the picture of the planes

    def __post_init__(self) -> None:
        super().__post_init__()
        check_increasing(self, "distance_m", "rim_m")


def planar_surface(options: PlanarOptions, state: Fused, map: Map | None, rest: bool) -> Surface:
    """The planes of the map and others in the mesh of all views, as polygons; with `rest` the triangles that lie in none stay, joined to them."""
    vertices, triangles = final_mesh(options, state, map)
    opposite = opposite_half_edges(triangles)
    ids, known = map_planes(map)
    labels, planes = planar_labels(vertices, vertex_normals(vertices, triangles), triangles, opposite, known, options)
    if not rest:
        vertices, triangles = with_single_fans(vertices, triangles[labels >= 0])
        labels = labels[labels >= 0]
        opposite = opposite_half_edges(triangles)
    flat = flattened(vertices, triangles, opposite, labels, planes, options.snap_m, options.outline_m, options.hole_m2)
    shown = flat.labels >= (REST if rest else 0)
    triangles, labels = without_pinholes(flat.vertices, flat.triangles[shown], flat.labels[shown])
    return pictured(state, map, flat.vertices, triangles, labels, planes, numbered(ids, len(planes), map), flat.loops, options.texel_m)


# Which triangles of a dense mesh lie in planes: those of the map first, then planes that only the mesh shows.


def planar_labels(vertices: F64, normals: F64, triangles: I32, opposite: I32, planes: F64, flat: PlanarOptions) -> tuple[I32, F64]:
    """(t,) row of the plane each triangle lies in, -1 for none, and the planes (p, 4): the given (n, 4), then those found in the mesh, fitted to
    it."""
    cosine = float(np.cos(np.radians(flat.angle_deg)))
    turned = normals[triangles].mean(axis=1)
    turned /= np.maximum(np.linalg.norm(turned, axis=1), 1e-12)[:, None]
    area, middle = triangle_areas(vertices, triangles), vertices[triangles].mean(axis=1)
    labels = on_planes(vertices, triangles, turned, planes, flat.distance_m, cosine)
    labels = _large(labels, middle, opposite, area, planes, flat)
    seeds = np.argsort(-np.abs(steadiness(turned, opposite)), kind="stable")
    grown, found = grown_kernel(seeds, labels, len(planes), middle, turned, area, opposite, flat.distance_m, cosine, flat.area_m2)
    planes = np.concatenate([planes, found])
    labels = _large(grown, middle, opposite, area, planes, flat)
    labels = _joined(labels, middle, area, opposite, planes, flat.distance_m)
    planes = _fitted(labels, middle, area, planes)
    for _ in range(flat.rim):
        labels = with_rim(labels, vertices, triangles, turned, opposite, planes, flat.rim_m)
    labels = without_steps(labels, triangles, len(vertices), planes, np.asarray(np.bincount(labels + 1, area, len(planes) + 1), np.float64)[1:])
    return _large(_filled(labels, vertices, triangles, opposite, planes, flat), middle, opposite, area, planes, flat), planes


def _joined(labels: I32, middle: F64, area: F64, opposite: I32, planes: F64, distance: float) -> I32:
    """Planes that touch, and of which the larger one fits the smaller one's triangles within the distance (RMS), are one, such as a floor that was
    mapped twice. The larger keeps its identity."""
    h = np.flatnonzero(opposite >= 0)
    here, there = labels[h // 3], labels[opposite[h] // 3]
    seams = (here >= 0) & (there >= 0) & (here != there)
    pairs = np.unique(np.stack([here[seams], there[seams]], axis=1), axis=0)
    total = np.bincount(labels + 1, area, len(planes) + 1)[1:]
    out, stands_for = labels.copy(), np.arange(len(planes))
    for small in np.argsort(total, kind="stable"):
        beside = np.unique(stands_for[pairs[stands_for[pairs[:, 0]] == small, 1]])
        rows = np.flatnonzero(out == small)
        beside = beside[(total[beside] >= total[small]) & (beside != small)]
        for large in beside[np.argsort(-total[beside], kind="stable")]:
            off = matmul(middle[rows], planes[large, :3]) + planes[large, 3]
            if matmul(planes[large, :3], planes[small, :3]) > 0.9 and np.average(off**2, weights=area[rows]) <= distance**2:
                out[rows], stands_for[stands_for == small] = large, large
                total[large] += total[small]
                break
    return out


def _fitted(labels: I32, middle: F64, area: F64, planes: F64) -> F64:
    """The planes, each moved to its triangles by least squares."""
    order = np.argsort(labels, kind="stable")
    bounds = np.searchsorted(labels[order], np.arange(len(planes) + 1))
    out = planes.copy()
    for p in range(len(planes)):
        rows = order[bounds[p] : bounds[p + 1]].astype(np.int32)
        if len(rows) >= 3:
            out[p, :3], out[p, 3] = plane_through(middle, area, rows, planes[p, :3].copy())
    return out


def _large(labels: I32, middle: F64, opposite: I32, area: F64, planes: F64, flat: PlanarOptions) -> I32:
    """The labels without the connected parts that are too small, or bent."""
    parts, count = connected(opposite, labels)
    total = np.bincount(parts, area, count)
    bend = bends(parts, count, labels, middle, area, planes)
    return np.where((total[parts] >= flat.area_m2) & (bend[parts] <= flat.bend_per_m), labels, -1).astype(np.int32)


def _filled(labels: I32, vertices: F64, triangles: I32, opposite: I32, planes: F64, flat: PlanarOptions) -> I32:
    """Small holes in a planar part, all about it and near its plane, belong to it."""
    parts, count = connected(opposite, labels)
    around = enclosing(parts, count, labels, opposite)
    near = np.ones(count, np.bool_)
    area = np.bincount(parts, triangle_areas(vertices, triangles), count)
    hole = (around >= 0) & (area < flat.area_m2)
    rows = np.flatnonzero((labels < 0) & hole[parts])
    plane = planes[around[parts[rows]]]
    off = np.abs(np.einsum("tkj,tj->tk", vertices[triangles[rows]], plane[:, :3]) + plane[:, 3:]).max(axis=1)
    near[parts[rows[off > flat.rim_m]]] = False
    rows = rows[near[parts[rows]]]
    out = labels.copy()
    out[rows] = around[parts[rows]]
    return out


# How curved the parts of a mesh are.


def bends(parts: I32, count: int, labels: I32, middle: F64, area: F64, planes: F64) -> F64:
    """(count,) larger principal curvature (1/m) of the quadric of least squares over each part's plane; 0 for parts without one."""
    frames = np.array([np.column_stack([plane_axes(plane), plane[:3]]) for plane in planes]).reshape(-1, 3, 3)
    return bends_kernel(parts, count, labels, middle, area, frames)


# The planar parts of a mesh as polygons: their loops simplified, cut into few triangles, and joined to what is beside them vertex by vertex.


@dataclass(frozen=True)
class Flattened:
    """A mesh (vertices (v, 3), some unused; triangles (t, 3)) with the plane of each triangle (t,), -1 = none, and the loops of the parts: (plane,
    vertices round it), as `types.Surface`."""

    vertices: F64
    triangles: I32
    labels: I32
    loops: list[tuple[int, I32]]


def flattened(
    vertices: F64, triangles: I32, opposite: I32, labels: I32, planes: F64, farthest_m: float, tolerance_m: float, hole_m2: float
) -> Flattened:  # fmt: skip
    """The mesh with each planar part on its plane and cut into few triangles, its outline within the tolerance. Where parts touch they share
    vertices: on the line where their planes meet, and along the triangles of no plane all of them."""
    if not (labels >= 0).any():
        return Flattened(vertices, triangles, labels, [])
    points = snapped(vertices, triangles, labels, planes, farthest_m)
    parts, _ = connected(opposite, labels)
    parts = np.where(labels >= 0, parts, REST).astype(np.int32)
    border = border_half_edges(parts, opposite)
    fixed = fixed_vertices(len(vertices), triangles, parts, opposite)
    keep, beside = kept_vertices(points, triangles, parts, opposite, border, fixed, tolerance_m)
    on_border = np.zeros(len(vertices), np.bool_)
    for ends in (triangles, triangles[:, [1, 2, 0]]):
        on_border[ends.ravel()[border]] = True
    triangles = triangles.copy()
    rows = decimated(points, triangles, labels, planes, on_border | fixed, on_border & ~keep & ~fixed, beside)
    triangles, labels, parts = triangles[rows], labels[rows], parts[rows]
    return _recut(points, triangles, labels, parts, planes, hole_m2)


def _recut(points: F64, triangles: I32, labels: I32, parts: I32, planes: F64, hole_m2: float) -> Flattened:
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
        doubled = set(owners[crowded(whole, opposite_half_edges(whole)) // 3].tolist()) & set(cuts)
        if not doubled:
            break
        cuts = {part: found for part, found in cuts.items() if part not in doubled}
    outlines = [(part, ring) for part in first for ring in rings[part] + (holes.get(part, []) if part not in cuts else [])]
    plane_of = np.full(parts.max() + 2, REST, np.int32)  # the last is that of the rest
    plane_of[parts] = labels
    found = plane_of[owners]
    backwards = np.einsum("ij,ij->i", triangle_normals(points, whole), np.append(planes, np.zeros((1, 4)), axis=0)[found, :3]) < 0.0
    found[backwards] = REST
    return Flattened(points, whole, found, [(int(plane_of[part]), ring) for part, ring in outlines])


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
    found = _numbered(corners.reshape(-1, 2), np.concatenate(flat), np.concatenate(rings))
    triangles = found.reshape(-1, 3) if found is not None else None
    if triangles is None:
        return None
    area = np.array([_area(corner) for corner in corners])
    return np.where(area[:, None] > 0.0, triangles, triangles[:, ::-1]).astype(np.int32)


def _area(ring: F64) -> float:
    """Signed area of a polygon (n, 2), positive when anticlockwise."""
    following = np.roll(ring, -1, axis=0)
    return float(0.5 * (ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]).sum())


def _numbered(corners: F64, flat: F64, numbers: I32) -> I32 | None:
    """The number of each corner (n, 2), by its exact coordinates among `flat` (m, 2); None when one is new."""
    order = np.lexsort((flat[:, 1], flat[:, 0]))
    keys, wanted = (np.ascontiguousarray(a).view([("x", "f8"), ("y", "f8")]).ravel() for a in (flat[order], corners))
    rows = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return numbers[order][rows] if (keys[rows] == wanted).all() else None


ROUNDS = 20  # at most, to unfold what lies the wrong way round after it was moved


def snapped(vertices: F64, triangles: I32, labels: I32, planes: F64, farthest_m: float) -> F64:
    """Vertices (v, 3), each moved to the nearest point that lies on all planes of the triangles about it, or, if that is too far, on the nearest
    plane."""
    rows, starts = planes_about(len(vertices), triangles, labels)
    points = snapped_kernel(vertices, rows, starts, planes, farthest_m)
    planar = labels >= 0
    flat, normals = triangles[planar], planes[labels[planar], :3]
    for _ in range(ROUNDS):
        if not unfold(points, flat, normals, rows, starts):
            break
    return points
