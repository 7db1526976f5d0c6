"""Keyframe views: reduced frames from which a surface is fused, and the novelty by which they are selected.

A view is retained while it observes enough that is new, so their number is bounded by the surface of the scene and not by the length of the sequence.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, I32, U8, Camera, Frame, Map, Planes, Pose
from trihedron.plugins.shared.image_reduction_kernels import average_blocks
from trihedron.plugins.shared.keyframe_views_kernels import add_readings, count_novel
from trihedron.plugins.shared.voxel_hash_kernels import I64, empty_table, reserve


@dataclass(frozen=True)
class KeyframeView:
    """A frame reduced to about `width` columns, with its pose. `labels` and `coefficients` are those of its planar regions, camera frame."""

    index: int
    camera: Camera  # of the reduced images
    depth_m: F32  # (h, w), 0 = none
    color: U8  # (h, w, 3)
    labels: U8  # (h, w), 0 = none, i + 1 = region i
    coefficients: F64  # (n, 4)
    T_world_camera: F64  # as estimated at the time
    T_reference_camera: F64
    reference: int  # keyframe, -1 = none
    keyframe: int  # that this frame became, -1 = none
    submap: int

    @property
    def tsdf_input(self) -> tuple[Camera, F32, U8, F64]:
        """Return what a TSDF fuses: camera, depth, labels and planes."""
        return self.camera, self.depth_m, self.labels, self.coefficients

    def final_pose(self, map: Map | None) -> F64 | None:
        """Return the final pose (4, 4): the keyframe's that the frame became, else relative to its reference keyframe; None when its sub-map is not
        merged with the first."""
        row = self.keyframe if self.keyframe >= 0 else self.reference
        if map is None or row < 0:
            return self.T_world_camera if self.submap == 0 else None
        if map.keyframes.rows("submap", np.array([row]))[0] != 0:
            return None
        T = np.asarray(map.keyframes.rows("T_world_camera", np.array([row]))[0], np.float64)
        return T if self.keyframe >= 0 else matmul(T, self.T_reference_camera)


def view_of(frame: Frame, planes: Planes, pose: Pose, map: Map | None, width: int, max_sigma_m: float) -> KeyframeView:
    """Reduce a frame to a view; depth whose standard deviation is above `max_sigma_m` is skipped. `map` is that of this very frame, or None."""
    step = max(1, round(frame.camera.width / width))
    depth, color = average_blocks(frame.depth_m, frame.color, step)
    camera, noise = frame.camera, frame.camera.depth_noise
    depth[~(noise.sigma_m(depth) <= max_sigma_m)] = 0.0  # NaN too
    h, w = depth.shape
    offset = (step - 1) / 2.0
    small = Camera(
        w, h, camera.fx / step, camera.fy / step, (camera.cx - offset) / step, (camera.cy - offset) / step, camera.fps, camera.depth_noise
    )  # fmt: skip
    rows, columns = (((np.arange(n) * step + offset) / planes.stride + 0.5).astype(int) for n in (h, w))
    grid = planes.labels
    labels = grid[np.minimum(rows, grid.shape[0] - 1)][:, np.minimum(columns, grid.shape[1] - 1)]
    newest = len(map.keyframes) - 1 if map is not None else -1
    became = newest if map is not None and newest > pose.reference and map.keyframes.rows("index", np.array([newest]))[0] == frame.index else -1
    return KeyframeView(
        frame.index, small, depth, color, np.ascontiguousarray(labels), planes.coefficients, pose.T_world_camera,
        pose.T_reference_camera, pose.reference, became, pose.submap,
    )  # fmt: skip


@dataclass
class Known:
    """Observed voxels of one world: cells of `side_m` and the information (1/m²) gathered about each."""

    side_m: float
    keys: I64 = field(default_factory=lambda: empty_table(1 << 12)[0])
    numbers: I32 = field(default_factory=lambda: empty_table(1 << 12)[1])
    information: F64 = field(default_factory=lambda: np.zeros(0))

    def novelty(self, points: F64, weight: F64, views: float) -> float:
        """Return the share of readings, points (n, 3) with information (n,) in 1/m², whose cell has less information than `views` times theirs."""
        return float(count_novel(self.keys, self.numbers, self.information, points, weight, self.side_m, views)) / max(len(points), 1)

    def learn(self, points: F64, weight: F64) -> None:
        """Add the readings of one view; a cell gains the largest information of those that fall into it."""
        self.keys, self.numbers = reserve(self.keys, self.numbers, len(points))
        count = len(self.information)
        gained = np.zeros(count + len(points))
        count = add_readings(self.keys, self.numbers, gained, points, weight, self.side_m, count)
        gained[: len(self.information)] += self.information
        self.information = gained[:count]


def readings(frame: Frame, T_world_camera: F64, step: int, max_sigma_m: float) -> tuple[F64, F64]:
    """Sample every `step`-th reading of a frame within `max_sigma_m`: points (n, 3) in the world, and information (n,) of their depth (1/m²)."""
    depth = frame.depth_m[step // 2 :: step, step // 2 :: step].astype(np.float64)
    sigma = frame.camera.depth_noise.sigma_m(depth)
    r, c = np.nonzero((depth > 0.0) & (sigma <= max_sigma_m))
    pixels = np.stack([c, r], axis=1) * step + step // 2
    points = matmul(frame.camera.back_project(pixels, depth[r, c]), T_world_camera[:3, :3].T) + T_world_camera[:3, 3]
    return points, 1.0 / sigma[r, c] ** 2
