"""Plane instances meshed one by one from sparse points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import AcuteDeg, PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, Frame, Map, Planes, Pose, Rotation, Surface
from trihedron.plugins.surface.colored_mesh import map_planes, number_planes, textured_surface
from trihedron.plugins.surface.observed_planes import observed_planes, points_on_planes
from trihedron.plugins.surface.planar_greedy_kernels import MOST, accept_edges
from trihedron.plugins.surface.plane_axes import plane_axes
from trihedron.plugins.surface.retained_views import RetainedViews, ViewOptions, add_view


@register("surface", "planar_greedy")
@dataclass(frozen=True)
class PlanarGreedy(ViewOptions):
    """Points of each plane of the map, found by a kd-tree and joined by greedy triangulation (paper, section V-B); in the plane's own axes."""

    angle_deg: AcuteDeg = 10.0  # between a region and the plane it belongs to (paper)
    distance_m: PositiveFloat = 0.05  # of its points from it, on average
    spacing_m: Annotated[float, Range(0.01)] = 0.07  # between the points of a plane
    radius_m: PositiveFloat = 5.0  # of the search for neighbours (paper)
    multiplier: Annotated[float, Range(above=1)] = 5.0  # times the distance to a point's nearest neighbour, beyond which it is joined to none (paper)
    pixel_step: PositiveInt = 4  # px between the readings that are gathered
    texel_m: Annotated[float, Range(0.001)] = 0.015  # of the picture of the planes

    def start(self) -> RetainedViews:
        """Return an empty state."""
        return RetainedViews()

    def add(self, state: RetainedViews, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> RetainedViews:
        """Retain the frame if it was tracked and shows something new."""
        add_view(self, state, frame, planes, rotation, pose, map)
        return state

    def finish(self, state: RetainedViews, map: Map | None) -> Surface:
        """One mesh for each plane that was seen."""
        views = state.views_at_final_poses(map)
        ids, known = map_planes(map)
        found = observed_planes(views, known, self.angle_deg, self.distance_m)
        axes = [plane_axes(plane) for plane in found.planes]
        points = points_on_planes(views, found, axes, self.spacing_m, self.pixel_step)
        meshes = [greedy_triangles(flat, self.radius_m, self.multiplier) for flat in points]
        first = np.cumsum([0, *(len(flat) for flat in points)])
        vertices = [matmul(flat, basis.T) - plane[3] * plane[:3] for flat, basis, plane in zip(points, axes, found.planes)]
        triangles = [mesh + np.int32(start) for mesh, start in zip(meshes, first)]
        labels = [np.full(len(mesh), p, np.int32) for p, mesh in enumerate(meshes)]
        return textured_surface(
            state, map, np.concatenate([np.empty((0, 3)), *vertices]), np.concatenate([np.empty((0, 3), np.int32), *triangles]),
            np.concatenate([np.empty(0, np.int32), *labels]), found.planes, number_planes(ids, len(found.planes), map), [], self.texel_m,
        )  # fmt: skip


def greedy_triangles(points: F64, radius_m: float, multiplier: float) -> I32:
    """Triangles (t, 3), anticlockwise, of points (n, 2). A point is joined to others within `multiplier` times the distance of its nearest
    neighbour, and within `radius_m`."""
    from scipy.spatial import cKDTree

    if len(points) < 3:
        return np.empty((0, 3), np.int32)
    tree = cKDTree(points)
    distance, nearest = tree.query(points, k=min(MOST, len(points)))
    reach = np.minimum(radius_m, multiplier * distance[:, 1])
    row, column = np.nonzero((distance <= reach[:, None]) & (distance > 0.0))
    other = nearest[row, column]
    keys = np.unique(np.minimum(row, other) * len(points) + np.maximum(row, other))
    edges = np.stack([keys // len(points), keys % len(points)], axis=1).astype(np.int32)
    length = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    order = np.argsort(length, kind="stable")
    return _faces(points, edges[order][accept_edges(points, edges[order], length[order], distance, nearest.astype(np.int32))])


def _faces(points: F64, edges: I32) -> I32:
    """The empty triangles of a graph without crossings: next neighbours round a vertex that are joined themselves."""
    both = np.concatenate([edges, edges[:, ::-1]])
    step = points[both[:, 1]] - points[both[:, 0]]
    order = np.lexsort((np.arctan2(step[:, 1], step[:, 0]), both[:, 0]))
    both = both[order]
    starts = np.searchsorted(both[:, 0], np.arange(len(points) + 1))
    following = np.arange(1, len(both) + 1)
    ends = starts[both[:, 0] + 1]
    following = np.where(following == ends, starts[both[:, 0]], following)
    a, b, c = both[:, 0], both[:, 1], both[following, 1]
    keys = np.sort(both[:, 0].astype(np.int64) * len(points) + both[:, 1])
    wanted = b.astype(np.int64) * len(points) + c
    joined = keys[np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)] == wanted
    u, v = points[b] - points[a], points[c] - points[a]
    good = joined & (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0.0) & (a < b) & (a < c)
    return np.asarray(np.stack([a, b, c], axis=1)[good].astype(np.int32))
