"""Meshes as values of the topic `surface`: coloured, with the facts about their planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, PLANE_KINDS, U8, Map, Surface
from trihedron.plugins.numerics.surfaces.half_edges import compacted, triangle_areas, vertex_normals
from trihedron.plugins.numerics.surfaces.painting import painted, spread
from trihedron.plugins.numerics.surfaces.texture_atlas import atlas_of
from trihedron.plugins.numerics.surfaces.view_fold import Gathered

LEVEL_DEG = 20.0  # a plane that leans by less is level, or upright
SAME_LEVEL_M, WIDE_M2, HIGH_M = 0.15, 0.5, 1.0  # floor and ceiling: this near to the lowest or highest wide one; a wall is wide and this high


def coloured(state: Gathered, map: Map | None, vertices: F64, triangles: I32) -> Surface:
    """A surface of triangles (t, 3) that belong to no plane."""
    views = state.settled(map)
    vertices, triangles, _ = compacted(vertices, triangles)
    colors = spread(vertices, *painted(vertices, vertex_normals(vertices, triangles), views))
    return replace(
        Surface.empty(state.index, state.stamp_ns),
        vertices_m=vertices.astype(np.float32),
        colors=colors,
        triangles=triangles,
        instances=np.full(len(triangles), -1, np.int32),
        texels=np.full((len(triangles), 3, 2), np.nan, np.float32),
        up=state.up(views),
    )


def pictured(
    state: Gathered, map: Map | None, vertices: F64, triangles: I32, labels: I32, planes: F64, ids: I32, loops: Sequence[tuple[int, I32]],
    texel_m: float,
) -> Surface:  # fmt: skip
    """A surface whose triangles (t, 3) lie in planes (p, 4) with ids (p,), or in none: `labels` (t,). Planes without a triangle are left out."""
    plain = coloured(state, map, vertices, triangles)
    _, _, renamed = compacted(vertices, triangles)
    used, rows = np.unique(labels, return_inverse=True)
    rows, used = (rows - 1, used[1:]) if len(used) and used[0] < 0 else (rows, used)
    planes, points = planes[used], plain.vertices_m.astype(np.float64)
    atlas = atlas_of(points, plain.triangles, rows, planes, state.settled(map), texel_m)
    rings = [(int(np.searchsorted(used, plane)), renamed[ring]) for plane, ring in loops]
    ends = np.cumsum([0, *(len(ring) for _, ring in rings)])
    areas = np.bincount(rows + 1, triangle_areas(points, plain.triangles), len(used) + 1)[1:].astype(np.float32)
    return replace(
        plain,
        instances=rows.astype(np.int32),
        plane_ids=ids[used],
        coefficients=planes,
        kinds=_kinds(planes, areas, points[plain.triangles] @ plain.up, rows, plain.up),
        areas_m2=areas,
        plane_colors=atlas.colors,
        loops=np.array([(plane, a, b) for (plane, _), a, b in zip(rings, ends[:-1], ends[1:])], np.int32).reshape(-1, 3),
        loop_vertices=np.concatenate([np.empty(0, np.int32), *(ring for _, ring in rings)]).astype(np.int32),
        atlas=atlas.image,
        texels=atlas.texels,
    )


def _heights(corners: F64, rows: I32, count: int) -> F64:
    """(p, 2) lowest and highest place of each plane, by the heights (t, 3) of its triangles' corners."""
    out = np.tile([np.inf, -np.inf], (count, 1))
    planar = rows >= 0
    np.minimum.at(out[:, 0], rows[planar], corners[planar].min(axis=1))
    np.maximum.at(out[:, 1], rows[planar], corners[planar].max(axis=1))
    return out


def _kinds(planes: F64, areas: F32, corners: F64, rows: I32, up: F64) -> U8:
    """(p,) rows of PLANE_KINDS; the most general one for all when nobody knows which way is up."""
    kinds = np.full(len(planes), PLANE_KINDS.index("plane"), np.uint8)
    if not np.isfinite(up).all():
        return kinds
    leaning, heights = planes[:, :3] @ up, _heights(corners, rows, len(planes))
    level, upright = np.cos(np.radians(LEVEL_DEG)), np.sin(np.radians(LEVEL_DEG))
    kinds[np.abs(leaning) > level] = PLANE_KINDS.index("horizontal")
    kinds[np.abs(leaning) < upright] = PLANE_KINDS.index("vertical")
    wide, middle = areas >= WIDE_M2, heights.mean(axis=1)
    kinds[(np.abs(leaning) < upright) & wide & (heights[:, 1] - heights[:, 0] >= HIGH_M)] = PLANE_KINDS.index("wall")
    for name, facing, end in (("floor", leaning > level, 1.0), ("ceiling", leaning < -level, -1.0)):
        if (facing & wide).any():
            last = (end * middle[facing & wide]).min()
            kinds[facing & (end * middle <= last + SAME_LEVEL_M)] = PLANE_KINDS.index(name)
    return kinds
