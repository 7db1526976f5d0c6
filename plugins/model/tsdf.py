"""A truncated signed distance field to track against."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, LOST, Frame, Pose, PredictedView, Table
from trihedron.plugins.model.common import BLOCKS, downsample, fuse_depth
from trihedron.plugins.model.common_kernels import Blocks, PosedCamera
from trihedron.plugins.model.tsdf_kernels import cast_kernel, ranges_kernel
from trihedron.plugins.shared.image_reduction_kernels import depth_normals, smoothed
from trihedron.plugins.shared.tsdf_volume_kernels import SIDE


@register("model", "tsdf")
@dataclass(frozen=True)
class TsdfModel:
    """Volumetric fusion of every frame, and the view predicted by raycasting from its pose (KinectFusion: Newcombe et al., ISMAR 2011; in hashed
    blocks as in InfiniTAM: Kähler et al., TVCG 2015; the paper's column "InfiniTAM"). It has no colour, and is not deformed by corrections.

    The blocks are the rows of the value's table, so that the wire `model@prev` is the only memory."""

    width: Annotated[int, Range(32, 4096)] = 320  # px, about, of the integrated depth and of the view
    voxel_m: PositiveFloat = 0.02
    truncation_m: PositiveFloat = 0.08
    most: Annotated[int, Range(1, 255)] = 100  # views, the limit of a voxel's weight

    def __post_init__(self) -> None:
        if self.truncation_m < 2.0 * self.voxel_m:
            raise ValueError(f"truncation_m: {self.truncation_m} is less than two voxels of {self.voxel_m} m")

    def __call__(self, frame: Frame, pose: Pose, previous: PredictedView | None) -> PredictedView | None:
        """Return the view from this frame's pose; None, so that the last one remains, while the camera is lost."""
        if pose.status == LOST:
            return None
        depth, color, intrinsics, camera = downsample(frame, pose, self.width)
        table = previous.model if previous is not None else Table.empty(BLOCKS)
        table, seen = fuse_depth(table, depth, camera, self.voxel_m, self.truncation_m, self.most)
        shown = cast(seen, camera, depth, self.voxel_m, self.truncation_m)
        T = np.array(pose.T_world_camera)
        return PredictedView(frame.index, frame.stamp_ns, T, shown, depth_normals(smoothed(shown, 3), intrinsics, 4), np.zeros_like(color), table)


def cast(blocks: Blocks, camera: PosedCamera, depth: F32, voxel: float, truncation: float) -> F32:
    """Raycast the depth (h, w) of the zero level, 0 = none, through the given blocks, into which `depth` (h, w) was integrated.

    The search begins shortly before the measured depth, up to which the ray is free."""
    ranges = ranges_kernel(blocks, camera, depth.shape, voxel * SIDE)
    return np.asarray(cast_kernel(blocks.keys, blocks.numbers, blocks.distance, blocks.weight, camera, ranges, depth, voxel, truncation))
