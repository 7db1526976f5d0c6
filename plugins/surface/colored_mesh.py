"""Meshes as values of the topic `surface`: coloured by the views, and with the properties of their planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Map, Surface
from trihedron.plugins.surface.half_edges import remove_unused_vertices, triangle_areas, vertex_normals
from trihedron.plugins.surface.plane_kinds import kinds_of_planes
from trihedron.plugins.surface.retained_views import RetainedViews
from trihedron.plugins.surface.texture_atlas import bake_atlas
from trihedron.plugins.surface.vertex_colors import fill_unseen, view_colors


def colored_surface(state: RetainedViews, map: Map | None, vertices: F64, triangles: I32) -> Surface:
    """A surface of triangles (t, 3) that belong to no plane."""
    views = state.views_at_final_poses(map)
    vertices, triangles, _ = remove_unused_vertices(vertices, triangles)
    colors = fill_unseen(vertices, *view_colors(vertices, vertex_normals(vertices, triangles), views))
    return replace(
        Surface.empty(state.index, state.stamp_ns),
        vertices_m=vertices.astype(np.float32),
        colors=colors,
        triangles=triangles,
        instances=np.full(len(triangles), -1, np.int32),
        texels=np.full((len(triangles), 3, 2), np.nan, np.float32),
        up=state.up(views),
    )


def textured_surface(
    state: RetainedViews, map: Map | None, vertices: F64, triangles: I32, labels: I32, planes: F64, ids: I32, loops: Sequence[tuple[int, I32]],
    texel_m: float,
) -> Surface:  # fmt: skip
    """A surface whose triangles (t, 3) lie in planes (p, 4) with ids (p,), or in none: `labels` (t,). Planes without a triangle are left out."""
    plain = colored_surface(state, map, vertices, triangles)
    _, _, renamed = remove_unused_vertices(vertices, triangles)
    used, rows = np.unique(labels, return_inverse=True)
    rows, used = (rows - 1, used[1:]) if len(used) and used[0] < 0 else (rows, used)
    planes, points = planes[used], plain.vertices_m.astype(np.float64)
    atlas = bake_atlas(points, plain.triangles, rows, planes, state.views_at_final_poses(map), texel_m)
    rings = [(int(np.searchsorted(used, plane)), renamed[ring]) for plane, ring in loops]
    ends = np.cumsum([0, *(len(ring) for _, ring in rings)])
    areas = np.bincount(rows + 1, triangle_areas(points, plain.triangles), len(used) + 1)[1:].astype(np.float32)
    return replace(
        plain,
        instances=rows.astype(np.int32),
        plane_ids=ids[used],
        coefficients=planes,
        kinds=kinds_of_planes(planes, areas, matmul(points[plain.triangles], plain.up), rows, plain.up),
        areas_m2=areas,
        plane_colors=atlas.colors,
        loops=np.array([(plane, a, b) for (plane, _), a, b in zip(rings, ends[:-1], ends[1:])], np.int32).reshape(-1, 3),
        loop_vertices=np.concatenate([np.empty(0, np.int32), *(ring for _, ring in rings)]).astype(np.int32),
        atlas=atlas.image,
        texels=atlas.texels,
    )


def map_planes(map: Map | None) -> tuple[I32, F64]:
    """Ids (n,) and coefficients (n, 4) of the living planes."""
    if map is None:
        return np.empty(0, np.int32), np.empty((0, 4))
    ids = np.flatnonzero(map.planes.column("alive")).astype(np.int32)
    return ids, map.planes.rows("coefficients", ids)


def number_planes(ids: I32, count: int, map: Map | None) -> I32:
    """Ids for `count` planes: the map's, then numbers that it has not given for those that are not in it."""
    first = len(map.planes) if map is not None else 0
    return np.concatenate([ids, np.arange(first, first + count - len(ids))]).astype(np.int32)
