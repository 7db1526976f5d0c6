"""All six degrees of freedom from two clouds by Open3D."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Frame, Pose
from trihedron.plugins.pose.dense_pose import first_pose
from trihedron.plugins.pose.open3d_relative_pose import relative_pose
from trihedron.plugins.shared.libraries import open3d
from trihedron.plugins.shared.open3d_clouds import cloud_with_normals, depth_cells

LEAST = 100  # points of a cloud


class IcpMethod(Enum):
    """Distances that ICP minimises."""

    point_to_plane = "TransformationEstimationPointToPlane"
    point_to_point = "TransformationEstimationPointToPoint"
    generalized = "TransformationEstimationForGeneralizedICP"


@register("pose", "open3d_icp")
@dataclass(frozen=True)
class Open3dIcp:
    """`open3d.pipelines.registration.registration_icp` (point to plane: Chen and Medioni, 1992) or `registration_generalized_icp` (Segal, Haehnel,
    Thrun, RSS 2009) of every `stride`-th pixel with the previous frame, from no motion, with Open3D's criteria.

    Depth alone, without a map. Library: Open3D (MIT; Zhou, Park, Koltun, arXiv:1801.09847), held to one thread: its sums split over threads change
    from run to run. The bytes may differ on another CPU."""

    method: IcpMethod = IcpMethod.point_to_plane
    stride: Annotated[int, Range(1, 16)] = 4  # px between the points of a cloud
    farthest_m: PositiveFloat = 0.07  # max_correspondence_distance
    iterations: PositiveInt = 30  # max_iteration
    min_share: Share = 0.3  # of the points that must have a partner

    def __call__(self, frame: Frame, previous_frame: Frame | None, previous: Pose | None) -> Pose:
        """Return the pose with status and reason; the identity for the first frame."""
        if previous is None or previous_frame is None:
            return first_pose(frame)
        source, target = (depth_cells(one, self.stride)[2] for one in (frame, previous_frame))
        if previous_frame.index != previous.index or min(len(source), len(target)) < LEAST:
            return relative_pose(frame, previous, np.eye(4), np.eye(6), 0.0, 1.0, self.min_share)
        T, share, rmse, information = self._align_clouds(cloud_with_normals(source), cloud_with_normals(target))
        return relative_pose(frame, previous, T, information, share, rmse, self.min_share)

    def _align_clouds(self, source: Any, target: Any) -> tuple[F64, float, float, F64]:
        """T_target_source (4, 4), the share of the points with a partner, their RMSE and Open3D's information matrix (6, 6)."""
        registration = open3d().pipelines.registration
        criteria = registration.ICPConvergenceCriteria(max_iteration=self.iterations)
        align = registration.registration_generalized_icp if self.method == IcpMethod.generalized else registration.registration_icp
        found = align(source, target, self.farthest_m, np.eye(4), getattr(registration, self.method.value)(), criteria)
        T = np.array(found.transformation, np.float64)
        if not np.isfinite(invert(T)).all():
            return np.eye(4), 0.0, 1.0, np.eye(6)
        information = registration.get_information_matrix_from_point_clouds(source, target, self.farthest_m, T)
        return T, float(found.fitness), float(found.inlier_rmse), np.array(information, np.float64)
