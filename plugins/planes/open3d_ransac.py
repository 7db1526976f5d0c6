"""Planes by Open3D's RANSAC."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, Frame, Normals, Planes
from trihedron.plugins.planes.grid_points import grid_points, on_finer_grid
from trihedron.plugins.planes.regions import EDGE, EDGE_M, RegionOptions, complete_planes, grid_of, least_cells
from trihedron.plugins.planes.trimmed_fit_kernels import MAX_REGIONS, fit_labelled
from trihedron.plugins.shared.depth_image_kernels import coarser
from trihedron.plugins.shared.libraries import RANDOM, open3d
from trihedron.plugins.shared.open3d_clouds import point_cloud


@register("planes", "open3d_ransac")
@dataclass(frozen=True)
class Open3dRansac(RegionOptions):
    """`open3d.geometry.PointCloud.segment_plane`, again and again on the points that are left; each plane is cut into connected regions.

    The regions are then grown and fitted as those of every detector, so that their covariance is comparable. Library: Open3D (MIT; Zhou, Park,
    Koltun, arXiv:1801.09847), held to one thread, its generator seeded for each frame. The bytes may differ on another CPU."""

    distance_m: PositiveFloat = 0.02  # distance_threshold; Open3D's tutorial uses 0.01 m for a Kinect at 1.5 m
    points: Annotated[int, Range(3, 10)] = 3  # ransac_n
    iterations: Annotated[int, Range(1, 100000)] = 100  # num_iterations, at most
    probability: Annotated[float, Range(above=0, below=1)] = 0.99999999
    rounds: Annotated[int, Range(1, MAX_REGIONS)] = 10  # planes taken away, at most
    min_share: Share = 0.02  # of the points: a smaller plane ends the search

    def __call__(self, frame: Frame, normals: Normals, rng: np.random.Generator) -> Planes:
        """Planes, largest first; `labels` on the grid of the normals."""
        from scipy.ndimage import label

        grid, stride = grid_of(frame, normals), normals.stride
        coarse = coarser(grid, EDGE, EDGE_M)
        rows, columns, points = grid_points(coarse)
        found, q = np.zeros(coarse.rho.shape, np.int32), [np.zeros((0, 3))]
        for member, plane in self._planes(points, rng):
            inliers = np.zeros(coarse.rho.shape, bool)
            inliers[rows[member], columns[member]] = True
            regions, number = label(inliers)
            found = np.where(regions > 0, regions + sum(map(len, q)), found).astype(np.int32)
            q.append(np.repeat(-plane[None, :3] / plane[3], number, axis=0))
        labels = on_finer_grid(found, grid)
        core, fitted = fit_labelled(grid, labels, np.concatenate(q), float(np.radians(self.cone_deg)), self.gate, least_cells(self, stride))
        return complete_planes(self, core, fitted, grid, frame, stride, flat=False)

    def _planes(self, points: F64, rng: np.random.Generator) -> list[tuple[I32, F64]]:
        """Rows of the inliers and (n, d) of each plane."""
        left, least = np.arange(len(points), dtype=np.int32), max(self.min_share * len(points), float(self.points), 3.0)
        out: list[tuple[I32, F64]] = []
        seed = int(rng.integers(2**31))
        with RANDOM:
            open3d().utility.random.seed(seed)
            while len(left) >= least and len(out) < self.rounds:
                plane, inliers = self._largest(points[left])
                if len(inliers) < least or abs(plane[3]) < self.distance_m:
                    break
                out.append((left[inliers], plane))
                left = np.delete(left, inliers)
        return out

    def _largest(self, points: F64) -> tuple[F64, Any]:
        cloud = point_cloud(points)
        plane, inliers = cloud.segment_plane(self.distance_m, self.points, self.iterations, self.probability)
        return np.asarray(plane, np.float64), np.asarray(inliers, np.int64)
