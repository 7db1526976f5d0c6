"""A truncated signed distance field by Open3D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.options import PositiveFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, Frame, Map, Planes, Pose, Rotation, Surface
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.shared.libraries import open3d
from trihedron.plugins.surface.colored_mesh import colored_surface
from trihedron.plugins.surface.retained_views import RetainedViews, ViewOptions, add_view


@register("surface", "open3d_voxels")
@dataclass(frozen=True)
class Open3dVoxels(ViewOptions):
    """`open3d.t.geometry.VoxelBlockGrid` (Dong, Lao, Kaess, Koltun, PAMI 2022) of the retained views at their final poses, without colour in the
    volume; every reading counts alike. No planes.

    Library: Open3D (MIT; Zhou, Park, Koltun, arXiv:1801.09847), held to one thread. The bytes may differ on another CPU."""

    voxel_m: PositiveFloat = 0.02
    truncation_voxels: PositiveFloat = 4.0  # trunc_voxel_multiplier
    blocks: PositiveInt = 10000  # of 16³ voxels, reserved
    least_weight: PositiveFloat = 1.0  # readings of a voxel, of which fewer are none

    def start(self) -> RetainedViews:
        """Return an empty state."""
        return RetainedViews()

    def add(self, state: RetainedViews, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> RetainedViews:
        """Retain the frame if it was tracked and shows something new."""
        add_view(self, state, frame, planes, rotation, pose, map)
        return state

    def finish(self, state: RetainedViews, map: Map | None) -> Surface:
        """The zero level of the distances, coloured by the views."""
        views = state.views_at_final_poses(map)
        if not views:
            return Surface.empty(state.index, state.stamp_ns)
        return colored_surface(state, map, *self._mesh(views))

    def _mesh(self, views: list[tuple[KeyframeView, F64]]) -> tuple[F64, I32]:
        """Vertices (v, 3) and triangles (t, 3)."""
        library = open3d()
        kinds = (library.core.float32, library.core.float32)
        grid = library.t.geometry.VoxelBlockGrid(("tsdf", "weight"), kinds, ((1), (1)), self.voxel_m, 16, self.blocks)
        nothing = np.empty((0, 3)), np.empty((0, 3), np.int32)
        used = False
        for view, T in views:
            used = self._integrate(library, grid, view, T) or used
        if not used:
            return nothing
        below = float(np.nextafter(np.float32(self.least_weight), np.float32(0.0)))  # a voxel of the threshold itself is not used
        try:
            mesh = grid.extract_triangle_mesh(weight_threshold=below)
        except RuntimeError:  # Open3D's answer to a volume without a surface
            return nothing
        if "indices" not in mesh.triangle or not len(mesh.triangle.indices):
            return nothing
        return mesh.vertex.positions.numpy().astype(np.float64), mesh.triangle.indices.numpy().astype(np.int32)

    def _integrate(self, library: Any, grid: Any, view: KeyframeView, T: F64) -> bool:
        """Fuse a view; False when it has no depth."""
        if not (view.depth_m > 0.0).any():
            return False
        depth = library.t.geometry.Image(np.ascontiguousarray(view.depth_m))
        intrinsics, extrinsics = library.core.Tensor(view.camera.K), library.core.Tensor(invert(T))
        far = float(view.depth_m.max()) + 1.0
        blocks = grid.compute_unique_block_coordinates(depth, intrinsics, extrinsics, 1.0, far, self.truncation_voxels)
        grid.integrate(blocks, depth, intrinsics, extrinsics, 1.0, far, self.truncation_voxels)
        return True
