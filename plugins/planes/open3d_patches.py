"""Planes by Open3D's planar patches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import AcuteDeg, NonNegativeFloat, NonNegativeInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Frame, Normals, Planes
from trihedron.plugins.planes.grid_points import grid_points, on_finer_grid
from trihedron.plugins.planes.regions import EDGE, EDGE_M, RegionOptions, complete_planes, grid_of, least_cells
from trihedron.plugins.planes.trimmed_fit_kernels import fit_labelled
from trihedron.plugins.shared.depth_image_kernels import coarser
from trihedron.plugins.shared.libraries import open3d
from trihedron.plugins.shared.open3d_clouds import cloud_with_normals

LEAST = 100  # points, of which patches are made: Open3D fails on a few


@register("planes", "open3d_patches")
@dataclass(frozen=True)
class Open3dPatches(RegionOptions):
    """`open3d.geometry.PointCloud.detect_planar_patches` (Araújo and Oliveira, Pattern Recognition 2020) with Open3D's defaults, on its own normals.

    The points within a patch's box are its region, which is then grown and fitted as that of every detector, so that the covariance is comparable.
    Library: Open3D (MIT; Zhou, Park, Koltun, arXiv:1801.09847), held to one thread. The bytes may differ on another CPU."""

    variance_deg: Annotated[float, Range(above=0, high=90)] = 60.0  # normal_variance_threshold_deg
    coplanarity_deg: AcuteDeg = 75.0
    outlier_ratio: Annotated[float, Range(0, 1)] = 0.75
    min_edge_m: NonNegativeFloat = 0.0  # min_plane_edge_length; 0 = 1 % of the cloud's extent
    min_points: NonNegativeInt = 0  # 0 = 0.1 % of the points

    def __call__(self, frame: Frame, normals: Normals) -> Planes:
        """Planes, largest first; `labels` on the grid of the normals."""
        grid, stride = grid_of(frame, normals), normals.stride
        coarse = coarser(grid, EDGE, EDGE_M)
        rows, columns, points = grid_points(coarse)
        found = np.zeros(coarse.rho.shape, np.int32)
        q, members = self._patches(points)
        for k, member in enumerate(members):
            free = member[found[rows[member], columns[member]] == 0]
            found[rows[free], columns[free]] = k + 1
        labels = on_finer_grid(found, grid)
        core, fitted = fit_labelled(grid, labels, q, float(np.radians(self.cone_deg)), self.gate, least_cells(self, stride))
        return complete_planes(self, core, fitted, grid, frame, stride, flat=False)

    def _patches(self, points: F64) -> tuple[F64, list[np.ndarray]]:
        """q (k, 3) of the planes, with `q · (x, y, z) = 1`, and the rows of the points in each patch, the largest first."""
        if len(points) < LEAST:
            return np.zeros((0, 3)), []
        cloud = cloud_with_normals(points)
        search = open3d().geometry.KDTreeSearchParamKNN(knn=30)
        options = self.variance_deg, self.coplanarity_deg, self.outlier_ratio, self.min_edge_m, self.min_points
        planes, members = [], []
        for box in cloud.detect_planar_patches(*options, search):
            normal = np.asarray(box.R)[:, 2]
            offset = float(matmul(normal, np.asarray(box.center)))
            if abs(offset) > 1e-3:  # else the plane contains the camera
                planes.append(normal / offset)
                members.append(np.asarray(box.get_point_indices_within_bounding_box(cloud.points), np.int64))
        order = sorted(range(len(planes)), key=lambda k: -len(members[k]))
        return np.array([planes[k] for k in order]).reshape(-1, 3), [members[k] for k in order]
