"""All six degrees of freedom from the pixels of two frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Frame, Pose
from trihedron.plugins.pose.dense_alignment import align, source_of, target_of
from trihedron.plugins.pose.dense_alignment_kernels import Residuals, Source, Target
from trihedron.plugins.pose.dense_pose import dense_pose, first_pose
from trihedron.plugins.pose.direct_kernels import student_weights_kernel
from trihedron.plugins.shared.image_reduction import pyramid
from trihedron.plugins.shared.image_reduction_kernels import depth_normals

REACH = 2  # px, to the readings a normal is made of


@register("pose", "direct")
@dataclass(frozen=True)
class Direct:
    """The motion since the previous frame under which brightness and depth agree best, coarse to fine on a pyramid, each pixel weighted by a
    bivariate t-distribution (Kerl, Sturm, Cremers, IROS 2013; the paper's column "DVO"). No features are used.

    Its odometry alone, without the publication's keyframes and pose graph. Directions that neither brightness nor depth observes are held."""

    least_cosine: ClassVar[float] = -1.0  # normals are not compared

    width: Annotated[int, Range(32)] = 320  # px, about, of the finest level
    levels: PositiveInt = 3
    most: Annotated[int, Range(100)] = 10000  # pixels of the finest level that are used, about
    iterations: PositiveInt = 10  # of a level, at most
    least_gradient: PositiveFloat = 5.0  # of brightness, 0 … 255, a pixel; less is noise
    farthest_m: PositiveFloat = 0.3  # from the surface, that a pixel may be
    motion_sigma_m: PositiveFloat = 0.1  # of no motion, per frame: a weak prior
    motion_sigma_deg: PositiveFloat = 5.0
    min_share: Share = 0.3  # of the pixels that must be seen again and agree

    def __call__(self, frame: Frame, previous_frame: Frame | None, previous: Pose | None) -> Pose:
        """Return the pose with status and reason; the identity for the first frame."""
        if previous is None or previous_frame is None:
            return first_pose(frame)
        gap = max(frame.index - previous_frame.index, 1)
        found = align(self, self._pairs(previous_frame, frame), np.eye(3), np.zeros(3), student_weights, gap)
        T = matmul(previous.T_world_camera, pose_matrix(found.R.T, matmul(-found.R.T, found.t)))
        reaching = previous_frame.index == previous.index
        return dense_pose(frame, previous, T, found, self.min_share if reaching else 2.0, "of the previous frame's pixels")

    def _pairs(self, before: Frame, now: Frame) -> list[tuple[Source, Target, int]]:
        """The previous frame's pixels and this frame's image on each level, the coarsest first."""
        noise: F64 = before.camera.depth_noise.sigma_m(np.arange(0.0, 16.0, 0.01))
        out = []
        for a, b in zip(pyramid(before, self.width, self.levels), pyramid(now, self.width, self.levels)):
            stride = max(1, round((a.gray.size / self.most) ** 0.5))
            source = source_of(a, noise, stride, depth_normals(a.depth_m, a.intrinsics, REACH))
            out.append((source, target_of(b, REACH), self.iterations))
        return out[::-1]


def student_weights(residuals: Residuals, source: Source) -> F64:
    """Weights (n, 3) of a bivariate t-distribution of brightness and depth, its 2 × 2 scale estimated from the residuals (Kerl, Sturm, Cremers, IROS
    2013); depth in units of the sensor's noise, which grows with its square."""
    return np.asarray(student_weights_kernel(residuals.r, residuals.cosine, source.sigma_m))
