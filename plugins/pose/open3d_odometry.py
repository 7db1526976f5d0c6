"""All six degrees of freedom from two images by Open3D."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from itertools import product

import cv2
import numpy as np

from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, F64, U8, Frame, Pose
from trihedron.plugins.pose.dense_pose import first_pose
from trihedron.plugins.pose.open3d_relative_pose import relative_pose
from trihedron.plugins.shared.libraries import open3d
from trihedron.plugins.shared.open3d_clouds import rgbd_image

LEAST_SIDE = 16  # px, of the coarsest image
BINOMIAL = np.array([1, 4, 6, 4, 1], np.float32) / np.float32(16)


class OdometryMethod(Enum):
    """Residuals of Open3D's odometry."""

    hybrid = "Hybrid"
    intensity = "Intensity"
    point_to_plane = "PointToPlane"


@register("pose", "open3d_odometry")
@dataclass(frozen=True)
class Open3dOdometry:
    """`open3d.t.pipelines.odometry.rgbd_odometry_multi_scale`: brightness and depth of the previous frame, coarse to fine (Park, Zhou, Koltun, ICCV
    2017), with Open3D's defaults but for the depth, which is used up to `depth_max_m`. Each level is a call of its own with images halved here: those
    that Open3D halves are rounded by where they lie in memory.

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
        T, share, rmse, information = self._align_images(frame, previous_frame) if reaching else _nothing()
        return relative_pose(frame, previous, T, information, share, rmse, self.min_share)

    def _align_images(self, frame: Frame, before: Frame) -> tuple[F64, float, float, F64]:
        """T_before_frame (4, 4), the share of the pixels that agree, the RMSE of these and Open3D's information matrix (6, 6)."""
        if min(frame.depth_m.shape) < 4 * LEAST_SIDE or not (before.depth_m > 0.0).any() or not (frame.depth_m > 0.0).any():
            return _nothing()
        odometry, tensor = open3d().t.pipelines.odometry, open3d().core.Tensor
        sources, targets = (self._pyramid(one) for one in (frame, before))
        counts = self.fine_iterations, self.middle_iterations, self.coarse_iterations
        losses = odometry.OdometryLossParams(depth_outlier_trunc=self.depth_outlier_m)
        T, share, rmse = tensor(np.eye(4)), 1.0, 0.0
        try:
            for level in (2, 1, 0):
                if counts[level]:
                    criteria = [odometry.OdometryConvergenceCriteria(counts[level], 1e-6, 1e-6)]
                    source, target = rgbd_image(*sources[level]), rgbd_image(*targets[level])
                    K, method = tensor(_halved_intrinsics(before.camera.K, level)), getattr(odometry.Method, self.method.value)
                    found = odometry.rgbd_odometry_multi_scale(source, target, K, T, 1.0, self.depth_max_m, criteria, method, losses)
                    T, share, rmse = found.transformation, float(found.fitness), float(found.inlier_rmse)
            depths = (rgbd_image(one.color, one.depth_m).depth for one in (frame, before))
            information = odometry.compute_odometry_information_matrix(
                *depths, tensor(before.camera.K), T, self.depth_outlier_m, 1.0, self.depth_max_m
            )
        except RuntimeError:  # Open3D's answer to a singular system
            return _nothing()
        moved = np.array(T.numpy(), np.float64)
        return (moved, share, rmse, np.array(information.numpy(), np.float64)) if np.isfinite(moved).all() else _nothing()

    def _pyramid(self, frame: Frame) -> list[tuple[U8, F32]]:
        """Colour (h, w, 3) and depth (h, w) of a frame, at half and at a quarter of the size; depth beyond `depth_max_m` is 0."""
        near = (frame.depth_m > 0.0) & (frame.depth_m < self.depth_max_m)
        levels = [(frame.color, np.where(near, frame.depth_m, np.float32(0.0)))]
        for _ in range(2):
            levels.append(halve_rgbd(*levels[-1], 2.0 * self.depth_outlier_m))
        return levels


def halve_rgbd(color: U8, depth_m: F32, jump_m: float) -> tuple[U8, F32]:
    """Halve colour (h, w, 3) and depth (h, w): pixel (x, y) is a binomial mean about (2x, 2y).

    Depth is the mean of the readings within `jump_m` of that in the middle; 0 where that has none. The values depend on no address, number of
    threads or processor: colours are integers, and sums of depth have a fixed order."""
    h, w = depth_m.shape[0] // 2, depth_m.shape[1] // 2
    middle, padded = depth_m[: 2 * h : 2, : 2 * w : 2], np.pad(depth_m, 2)
    total, weight = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32)
    for row, column in product(range(5), repeat=2):
        reading = padded[row : row + 2 * h : 2, column : column + 2 * w : 2]
        share = BINOMIAL[row] * BINOMIAL[column] * ((reading > 0.0) & (np.abs(reading - middle) < jump_m))
        total += share * reading
        weight += share
    depth = np.divide(total, weight, out=np.zeros_like(total), where=middle > 0.0)
    return np.asarray(cv2.pyrDown(color, dstsize=(w, h)), np.uint8), depth


def _halved_intrinsics(K: F64, level: int) -> F64:
    """K (3, 3) of an image halved `level` times, whose pixel (x, y) lies at (2x, 2y) of the larger one."""
    return np.asarray(K * np.array([[0.5**level], [0.5**level], [1.0]]), np.float64)


def _nothing() -> tuple[F64, float, float, F64]:
    return np.eye(4), 0.0, 1.0, np.eye(6)
