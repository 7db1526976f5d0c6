"""All six degrees of freedom against the view of a dense model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, ClassVar

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import AcuteDeg, NonNegativeFloat, PositiveFloat, PositiveInt, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Frame, Pose, PredictedView
from trihedron.plugins.pose.dense_alignment import align, source_of, target_of
from trihedron.plugins.pose.dense_alignment_kernels import Residuals, Source, Target
from trihedron.plugins.pose.dense_pose import dense_pose, first_pose, lost_pose
from trihedron.plugins.shared.image_reduction import Level, brightness, halvings, pyramid, reduced_intrinsics
from trihedron.plugins.shared.image_reduction_kernels import depth_normals, smooth_depth


@register("pose", "icp")
@dataclass(frozen=True)
class Icp:
    """Frame to model: projective association and point-to-plane distances, coarse to fine (Newcombe et al., ISMAR 2011); with `photometric` the
    brightness of the predicted view as well (Whelan et al., RSS 2015).

    It starts at the previous pose. The model is its map, so a lost camera that returns to where it was lost is relocalised, by a stricter test."""

    needs: ClassVar[tuple[str, ...]] = ("model",)  # though there is none in the first frame

    photometric: NonNegativeFloat = 0.0  # weight of brightness besides its noise; 0 = depth alone, colour is not used
    levels: PositiveInt = 3
    most: Annotated[int, Range(100)] = 10000  # pixels of the finest level that are used, about
    iterations: PositiveInt = 8  # of a level, at most
    farthest_m: PositiveFloat = 0.1  # from the surface, that a pixel may be (KinectFusion)
    most_deg: AcuteDeg = 30.0  # between the normals of a pixel and of the surface
    floor_m: PositiveFloat = 0.003  # error of the model's surface
    least_gradient: PositiveFloat = 5.0  # of brightness, 0 … 255, a pixel; less is noise
    motion_sigma_m: PositiveFloat = 0.1  # of no motion, per frame: a weak prior
    motion_sigma_deg: PositiveFloat = 5.0
    min_share: Share = 0.3  # of the pixels that must fall on the model and agree

    def __call__(self, frame: Frame, previous: Pose | None, model: PredictedView | None) -> Pose:
        """Return the pose with status and reason; the identity for the first frame; lost, and held at the previous pose, where there is no view."""
        if previous is None:
            return first_pose(frame)
        if model is None:
            return lost_pose(frame, previous, "there is no view of a model")
        gap = max(frame.index - previous.index, 1)
        start = matmul(invert(model.T_world_camera), previous.T_world_camera)
        found = align(self, self._pairs(frame, model), start[:3, :3], start[:3, 3], partial(huber_weights, self), gap)
        T = matmul(model.T_world_camera, pose_matrix(found.R, found.t))
        return dense_pose(frame, previous, T, found, self.min_share, "of the pixels and the model", ends_loss=True)

    @property
    def least_cosine(self) -> float:
        """Cosine of `most_deg`."""
        return float(np.cos(np.radians(self.most_deg)))

    def _pairs(self, frame: Frame, model: PredictedView) -> list[tuple[Source, Target, int]]:
        """The frame's pixels and the model's view on each level, the coarsest first."""
        noise: F64 = frame.camera.depth_noise.sigma_m(np.arange(0.0, 16.0, 0.01))
        width = model.depth_m.shape[1]
        step = max(1, round(frame.camera.width / width))
        gray = np.where(model.depth_m > 0.0, brightness(model.color), np.float32(np.nan))
        views = halvings(Level(gray, np.array(model.depth_m), reduced_intrinsics(frame, step)), self.levels)
        out = []
        for i, (now, view) in enumerate(zip(pyramid(frame, width, self.levels), views)):
            stride = max(1, round((now.gray.size / self.most) ** 0.5))
            source = source_of(now, noise, stride, depth_normals(smooth_depth(now.depth_m, 3), now.intrinsics, 4))
            out.append((source, target_of(view, 3, np.array(model.normals) if i == 0 else None), self.iterations))
        return out[::-1]


HUBER = 1.345


def huber_weights(options: Icp, residuals: Residuals, source: Source) -> F64:
    """Huber weights (n, 3) of point-to-plane distances in units of the sensor's noise and `options.floor_m`, and of brightness in units of its median
    residual, the latter multiplied by `options.photometric`."""
    W, seen = np.zeros((len(residuals.r), 3)), residuals.cosine > 0.0
    if not seen.any():
        return W
    off = np.abs(residuals.r[seen])
    brightness_scale = np.array([max(1.4826 * float(np.median(off[:, 0])), 1.0)])
    scale = brightness_scale, np.hypot(source.sigma_m[seen] * residuals.cosine[seen], options.floor_m)
    for k, column, share in ((0, 0, options.photometric), (1, 2, 1.0)):
        e = off[:, k] / scale[k]
        W[seen, column] = share * np.minimum(1.0, HUBER / np.maximum(e, 1e-9)) / scale[k] ** 2
    return W
