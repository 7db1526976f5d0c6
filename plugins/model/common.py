"""A truncated signed distance field as the rows of a table, so that it is the value of a wire: a row is a block of 8 × 8 × 8 voxels.

Versions of the table share the chunks that a frame does not touch, and a recording holds the changes. Distances are shares of the truncation in
16 bits, weights numbers of views in 8, as in InfiniTAM (Kähler et al., TVCG 2015). Voxel i of block b is at (b · SIDE + i) · voxel_m in the world.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, U8, Column, Frame, Pose, Table
from trihedron.plugins.model.common_kernels import Blocks, PosedCamera, in_view, insert, integrate
from trihedron.plugins.shared.image_reduction import reduced_intrinsics, step_to
from trihedron.plugins.shared.image_reduction_kernels import reduced
from trihedron.plugins.shared.tsdf_volume import CELLS, blocks_about
from trihedron.plugins.shared.tsdf_volume_kernels import SIDE
from trihedron.plugins.shared.voxel_hash_kernels import I64, absent, empty_table

BLOCKS = {"place": Column("i4", (3,)), "distance": Column("i2", (CELLS,)), "weight": Column("u1", (CELLS,))}


def posed_camera(intrinsics: F64, T_world_camera: F64) -> PosedCamera:
    """Combine intrinsics (fx, fy, cx, cy) with a pose (4, 4)."""
    return PosedCamera(intrinsics, np.ascontiguousarray(T_world_camera[:3, :3].T), T_world_camera[:3, 3].copy())


def fuse_depth(table: Table, depth: F32, camera: PosedCamera, voxel: float, truncation: float, most: int) -> tuple[Table, Blocks]:
    """Integrate a depth image (h, w) into the table; also returns its blocks in view. A voxel's weight is limited to `most` views."""
    T, no_plane = np.column_stack([camera.R_camera_world.T, camera.position_m]), np.zeros(depth.shape, np.uint8)
    touched = blocks_about(depth, no_plane, np.zeros((1, 5)), camera.intrinsics, T, voxel * SIDE, truncation)
    places = table.column("place")
    known, _ = _hash_table(places)
    fresh = touched[absent(known, touched)]
    near = np.flatnonzero(in_view(places, camera, depth.shape, voxel * SIDE)).astype(np.int32)
    count = len(near)
    distance = np.concatenate([table.rows("distance", near), np.zeros((len(fresh), CELLS), np.int16)])
    weight = np.concatenate([table.rows("weight", near), np.zeros((len(fresh), CELLS), np.uint8)])
    seen = Blocks(*_hash_table(np.concatenate([places[near], fresh])), np.concatenate([places[near], fresh]), distance, weight)
    changed = integrate(seen, touched, depth, camera, voxel, truncation, most)
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


# The downsampled frame that is integrated into a dense model.


class DownsampledFrame(NamedTuple):
    """A frame downsampled to about a width, with its intrinsics (fx, fy, cx, cy) and its camera at its pose."""

    depth_m: F32  # (h, w), 0 = none
    color: U8  # (h, w, 3)
    intrinsics: F64
    camera: PosedCamera


def downsample(frame: Frame, pose: Pose, width: int) -> DownsampledFrame:
    """Downsample a frame and attach its pose."""
    step = step_to(frame, width)
    intrinsics = reduced_intrinsics(frame, step)
    depth_m, color = reduced(frame.depth_m, frame.color, step)
    return DownsampledFrame(depth_m, color, intrinsics, posed_camera(intrinsics, pose.T_world_camera))
