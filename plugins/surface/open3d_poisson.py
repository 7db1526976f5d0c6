"""A surface by Open3D's Poisson reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, Frame, Map, Planes, Pose, Rotation, Surface
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.shared.libraries import open3d
from trihedron.plugins.shared.open3d_clouds import cloud_with_normals
from trihedron.plugins.surface.colored_mesh import colored_surface
from trihedron.plugins.surface.retained_views import RetainedViews, ViewOptions, add_view

LEAST = 100  # points of a cloud


@register("surface", "open3d_poisson")
@dataclass(frozen=True)
class Open3dPoisson(ViewOptions):
    """`open3d.geometry.TriangleMesh.create_from_point_cloud_poisson` (screened Poisson: Kazhdan and Hoppe, ToG 2013) of the readings of the retained
    views, thinned to `voxel_m`, with Open3D's normals; vertices far from every reading are removed, for Poisson closes every hole. No planes.

    Library: Open3D (MIT; Zhou, Park, Koltun, arXiv:1801.09847), one thread. The bytes may differ on another CPU."""

    voxel_m: PositiveFloat = 0.02  # side of the cells in which readings are averaged
    depth: Annotated[int, Range(1, 12)] = 8  # of the octree
    scale: PositiveFloat = 1.1  # of the reconstruction cube
    max_distance_m: PositiveFloat = 0.04  # to the nearest reading, beyond which vertices are removed
    point_weight: NonNegativeFloat = 2.0  # of the screening

    def start(self) -> RetainedViews:
        """Return an empty state."""
        return RetainedViews()

    def add(self, state: RetainedViews, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> RetainedViews:
        """Retain the frame if it was tracked and shows something new."""
        add_view(self, state, frame, planes, rotation, pose, map)
        return state

    def finish(self, state: RetainedViews, map: Map | None) -> Surface:
        """The reconstructed surface, coloured by the views."""
        views = state.views_at_final_poses(map)
        return colored_surface(state, map, *self._mesh(views)) if views else Surface.empty(state.index, state.stamp_ns)

    def _mesh(self, views: list[tuple[KeyframeView, F64]]) -> tuple[F64, I32]:
        """Vertices (v, 3) and triangles (t, 3)."""
        from scipy.spatial import cKDTree

        geometry, cloud = open3d().geometry, open3d().geometry.PointCloud()
        for view, T in views:
            points = _points(view)
            if len(points) >= LEAST:
                cloud += cloud_with_normals(points).transform(T)
        cloud = cloud.voxel_down_sample(self.voxel_m)
        if len(cloud.points) < LEAST:
            return np.empty((0, 3)), np.empty((0, 3), np.int32)
        options = {"depth": self.depth, "scale": self.scale, "n_threads": 1, "point_weight": self.point_weight}
        mesh, _ = geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, **options)
        distance_m, _ = cKDTree(np.asarray(cloud.points)).query(np.asarray(mesh.vertices))
        mesh.remove_vertices_by_mask(distance_m > self.max_distance_m)
        return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.triangles, np.int32)


def _points(view: KeyframeView) -> F64:
    """(n, 3) readings of a view in its camera frame."""
    rows, columns = np.nonzero(view.depth_m > 0.0)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    return np.asarray(view.camera.back_project(pixels, view.depth_m[rows, columns].astype(np.float64)), np.float64)
