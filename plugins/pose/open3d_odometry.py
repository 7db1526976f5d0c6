"""All six degrees of freedom from two images by Open3D."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Frame, Pose
from trihedron.plugins.pose.common import first_pose
from trihedron.plugins.pose.common_open3d import relative_pose
from trihedron.plugins.shared.libraries import open3d
from trihedron.plugins.shared.open3d_clouds import rgbd_image

LEAST_SIDE = 16  # px, of the coarsest image


class OdometryMethod(Enum):
    """Residuals of Open3D's odometry."""

    hybrid = "Hybrid"
    intensity = "Intensity"
    point_to_plane = "PointToPlane"


@register("pose", "open3d_odometry")
@dataclass(frozen=True)
class Open3dOdometry:
    """`open3d.t.pipelines.odometry.rgbd_odometry_multi_scale`: brightness and depth of the previous frame, coarse to fine (Park, Zhou, Koltun, ICCV
    2017), with Open3D's defaults but for the depth, which is used up to `depth_max_m`.

    From frame to frame, without a map. Library: Open3D (MIT; Zhou, Park, Koltun, arXiv:1801.09847), held to one thread: its sums split over threads
    change from run to run. The bytes may differ on another CPU."""

    method: OdometryMethod = OdometryMethod.hybrid
    depth_max_m: PositiveFloat = 6.0  # depth_max; Open3D's own is 3
    coarse_iterations: NonNegativeInt = 10  # of the criteria, at a quarter of the size
    middle_iterations: NonNegativeInt = 5
    fine_iterations: NonNegativeInt = 3
    depth_outlier_m: PositiveFloat = 0.07  # depth_outlier_trunc
    min_share: Share = 0.1  # of the image's pixels that must agree; those without depth never do

    def __call__(self, frame: Frame, previous_frame: Frame | None, previous: Pose | None) -> Pose:
        """Return the pose with status and reason; the identity for the first frame."""
        if previous is None or previous_frame is None:
            return first_pose(frame)
        reaching = previous_frame.index == previous.index and frame.depth_m.shape == previous_frame.depth_m.shape
        T, share, rmse, information = self._aligned(frame, previous_frame) if reaching else _nothing()
        return relative_pose(frame, previous, T, information, share, rmse, self.min_share)

    def _aligned(self, frame: Frame, before: Frame) -> tuple[F64, float, float, F64]:
        """T_before_frame (4, 4), the share of the pixels that agree, the RMSE of these and Open3D's information matrix (6, 6)."""
        if min(frame.depth_m.shape) < 4 * LEAST_SIDE or not (before.depth_m > 0.0).any() or not (frame.depth_m > 0.0).any():
            return _nothing()
        library = open3d()
        odometry, source, target = library.t.pipelines.odometry, rgbd_image(frame), rgbd_image(before)
        intrinsics, start = library.core.Tensor(before.camera.K), library.core.Tensor(np.eye(4))
        losses = odometry.OdometryLossParams(depth_outlier_trunc=self.depth_outlier_m)
        try:
            found = odometry.rgbd_odometry_multi_scale(
                source,
                target,
                intrinsics,
                start,
                1.0,
                self.depth_max_m,
                self._criteria(odometry),
                getattr(odometry.Method, self.method.value),
                losses,
            )
            T = found.transformation
            information = odometry.compute_odometry_information_matrix(
                source.depth, target.depth, intrinsics, T, self.depth_outlier_m, 1.0, self.depth_max_m
            )
        except RuntimeError:  # Open3D's answer to a singular system
            return _nothing()
        moved = np.array(T.numpy(), np.float64)
        good = np.isfinite(moved).all()
        return (moved, float(found.fitness), float(found.inlier_rmse), np.array(information.numpy(), np.float64)) if good else _nothing()

    def _criteria(self, odometry: Any) -> list[Any]:
        iterations = self.coarse_iterations, self.middle_iterations, self.fine_iterations
        return [odometry.OdometryConvergenceCriteria(count, 1e-6, 1e-6) for count in iterations]


def _nothing() -> tuple[F64, float, float, F64]:
    return np.eye(4), 0.0, 1.0, np.eye(6)
