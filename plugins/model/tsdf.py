"""A truncated signed distance field to track against."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, I32, LOST, Column, Frame, Pose, PredictedView, Table
from trihedron.plugins.model.downsampled_frame import PosedCamera, downsample
from trihedron.plugins.model.tsdf_kernels import Blocks, cast_kernel, in_view, insert, integrate, ranges_kernel
from trihedron.plugins.shared.image_reduction_kernels import depth_normals, smooth_depth
from trihedron.plugins.shared.tsdf_volume import CELLS, blocks_about
from trihedron.plugins.shared.tsdf_volume_kernels import SIDE
from trihedron.plugins.shared.voxel_hash_kernels import I64, absent, empty_table


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
        table, seen = fuse_depth(self, table, depth, camera)
        shown = cast(self, seen, camera, depth)
        T = np.array(pose.T_world_camera)
        return PredictedView(frame.index, frame.stamp_ns, T, shown, depth_normals(smooth_depth(shown, 3), intrinsics, 4), np.zeros_like(color), table)


# The blocks of 8 × 8 × 8 voxels are the rows of a table, so that they are the value of a wire: versions of it share the chunks that a frame does not
# touch, and a recording holds the changes. Distances are shares of the truncation in 16 bits, weights numbers of views in 8, as in InfiniTAM (Kähler
# et al., TVCG 2015). Voxel i of block b is at (b · SIDE + i) · voxel_m in the world.

BLOCKS = {"place": Column("i4", (3,)), "distance": Column("i2", (CELLS,)), "weight": Column("u1", (CELLS,))}


def fuse_depth(options: TsdfModel, table: Table, depth: F32, camera: PosedCamera) -> tuple[Table, Blocks]:
    """Integrate a depth image (h, w) into the table; also returns its blocks in view. A voxel's weight is limited to `options.most` views."""
    T, no_plane = np.column_stack([camera.R_camera_world.T, camera.position_m]), np.zeros(depth.shape, np.uint8)
    touched = blocks_about(depth, no_plane, np.zeros((1, 5)), camera.intrinsics, T, options.voxel_m * SIDE, options.truncation_m)
    places = table.column("place")
    known, _ = _hash_table(places)
    fresh = touched[absent(known, touched)]
    near = np.flatnonzero(in_view(places, camera, depth.shape, options.voxel_m * SIDE)).astype(np.int32)
    count = len(near)
    distance = np.concatenate([table.rows("distance", near), np.zeros((len(fresh), CELLS), np.int16)])
    weight = np.concatenate([table.rows("weight", near), np.zeros((len(fresh), CELLS), np.uint8)])
    seen = Blocks(*_hash_table(np.concatenate([places[near], fresh])), np.concatenate([places[near], fresh]), distance, weight)
    changed = integrate(seen, touched, depth, camera, options.voxel_m, options.truncation_m, options.most)
    old = np.flatnonzero(changed[:count])
    table = table.updated(near[old], distance=distance[old], weight=weight[old]) if len(old) else table
    table, _ = table.appended(place=fresh, distance=distance[count:], weight=weight[count:])
    return table, seen


def _hash_table(places: I32) -> tuple[I64, I32]:
    """Hash table of places (n, 3) -> row."""
    slots = 1 << 10
    while slots < 3 * len(places):
        slots *= 2
    keys, numbers = empty_table(slots)
    insert(keys, numbers, places)
    return keys, numbers


def cast(options: TsdfModel, blocks: Blocks, camera: PosedCamera, depth: F32) -> F32:
    """Raycast the depth (h, w) of the zero level, 0 = none, through the given blocks, into which `depth` (h, w) was integrated.

    The search begins shortly before the measured depth, up to which the ray is free."""
    ranges = ranges_kernel(blocks, camera, depth.shape, options.voxel_m * SIDE)
    return np.asarray(
        cast_kernel(blocks.keys, blocks.numbers, blocks.distance, blocks.weight, camera, ranges, depth, options.voxel_m, options.truncation_m)
    )
