"""The downsampled frame that is integrated into a dense model, with its camera at its pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.types import F32, F64, U8, Frame, Pose
from trihedron.plugins.shared.image_reduction import reduced_intrinsics, step_to
from trihedron.plugins.shared.image_reduction_kernels import average_blocks

NEAREST_M = 0.1


class PosedCamera(NamedTuple):
    """Intrinsics of an image and the pose of its camera."""

    intrinsics: F64  # (fx, fy, cx, cy)
    R_camera_world: F64
    position_m: F64


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
    depth_m, color = average_blocks(frame.depth_m, frame.color, step)
    return DownsampledFrame(depth_m, color, intrinsics, posed_camera(intrinsics, pose.T_world_camera))


def posed_camera(intrinsics: F64, T_world_camera: F64) -> PosedCamera:
    """Combine intrinsics (fx, fy, cx, cy) with a pose (4, 4)."""
    return PosedCamera(intrinsics, np.ascontiguousarray(T_world_camera[:3, :3].T), T_world_camera[:3, 3].copy())
