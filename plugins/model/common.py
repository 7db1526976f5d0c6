"""A truncated signed distance field as the rows of a table, so that it can travel on a wire: a row is a block of 8 × 8 × 8 voxels.

Versions of the table share the chunks that a frame does not touch, and a recording holds the changes. Distances are shares of the truncation in
16 bits, weights numbers of views in 8, as in InfiniTAM (Kähler et al., TVCG 2015). Voxel i of block b is at (b · SIDE + i) · voxel_m in the world.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, U8, Column, Frame, Pose, Table
from trihedron.plugins.model.common_kernels import Blocks, Lens, in_view, insert, integrate
from trihedron.plugins.shared.image_reduction import lens_of, step_to
from trihedron.plugins.shared.image_reduction_kernels import reduced
from trihedron.plugins.shared.tsdf_volume import CELLS, blocks_about
from trihedron.plugins.shared.tsdf_volume_kernels import SIDE
from trihedron.plugins.shared.voxel_hash import empty_table
from trihedron.plugins.shared.voxel_hash_kernels import I64, absent

BLOCKS = {"place": Column("i4", (3,)), "distance": Column("i2", (CELLS,)), "weight": Column("u1", (CELLS,))}


def lens_at(lens: F64, T_world_camera: F64) -> Lens:
    """A camera at a pose."""
    return Lens(lens, np.ascontiguousarray(T_world_camera[:3, :3].T), T_world_camera[:3, 3].copy())


def fused(table: Table, depth: F32, camera: Lens, voxel: float, truncation: float, most: int) -> tuple[Table, Blocks]:
    """The table with one depth image (h, w) taken in, and those of its blocks that the camera may see. A voxel's weight ends at `most` views."""
    T, no_plane = np.column_stack([camera.R_camera_world.T, camera.position_m]), np.zeros(depth.shape, np.uint8)
    touched = blocks_about(depth, no_plane, np.zeros((1, 5)), camera.lens, T, voxel * SIDE, truncation)
    places = table.column("place")
    known, _ = _hashed(places)
    fresh = touched[absent(known, touched)]
    near = np.flatnonzero(in_view(places, camera, depth.shape, voxel * SIDE)).astype(np.int32)
    count = len(near)
    distance = np.concatenate([table.rows("distance", near), np.zeros((len(fresh), CELLS), np.int16)])
    weight = np.concatenate([table.rows("weight", near), np.zeros((len(fresh), CELLS), np.uint8)])
    seen = Blocks(*_hashed(np.concatenate([places[near], fresh])), np.concatenate([places[near], fresh]), distance, weight)
    changed = integrate(seen, touched, depth, camera, voxel, truncation, most)
    old = np.flatnonzero(changed[:count])
    table = table.updated(near[old], distance=distance[old], weight=weight[old]) if len(old) else table
    table, _ = table.appended(place=fresh, distance=distance[count:], weight=weight[count:])
    return table, seen


def _hashed(places: I32) -> tuple[I64, I32]:
    """A hash table of places (n, 3) -> row."""
    slots = 1 << 10
    while slots < 3 * len(places):
        slots *= 2
    keys, numbers = empty_table(slots)
    insert(keys, numbers, places)
    return keys, numbers


# What a dense model takes in of a frame.

class Sight(NamedTuple):
    """A frame reduced to about a width, with its lens (fx, fy, cx, cy) and its camera at its pose."""

    depth_m: F32  # (h, w), 0 = none
    color: U8  # (h, w, 3)
    lens: F64
    camera: Lens


def sight_of(frame: Frame, pose: Pose, width: int) -> Sight:
    """The frame as the model sees it."""
    step = step_to(frame, width)
    lens = lens_of(frame, step)
    depth_m, color = reduced(frame.depth_m, frame.color, step)
    return Sight(depth_m, color, lens, lens_at(lens, pose.T_world_camera))
