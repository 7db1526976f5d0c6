"""A rotation with its covariance and source, before and after an estimator."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg_kernels import polar_rotation
from trihedron.pipeline.core.types import F64, LOST, Pose, Rotation
from trihedron.plugins.rotation.known_frames import KnownFrames

IDENTITY = np.eye(3)


@dataclass(frozen=True)
class Estimate:
    """A rotation R_world_camera (3, 3), the covariance of phi in `R · Exp(phi)` (3, 3) and where it comes from (manhattan | tracks | prediction)."""

    R: F64
    covariance: F64
    source: str


def rotation_before(previous: Rotation, previous_pose: Pose | None, floor_deg: float) -> tuple[Estimate, bool]:
    """The previous frame's rotation, and True if it is that of its refined pose.

    `floor_deg` is the least σ of the latter: the map that it was refined against drifts, which its covariance does not include."""
    if previous_pose is not None and previous_pose.index == previous.index and previous_pose.status != LOST:
        floor = IDENTITY * math.radians(floor_deg) ** 2
        return Estimate(previous_pose.T_world_camera[:3, :3], previous_pose.local_covariance[3:, 3:] + floor, previous.source), True
    return Estimate(previous.R_world_camera, previous.covariance, previous.source), False


def rotation_value(index: int, stamp_ns: int, estimate: Estimate, known: KnownFrames, seen: F64) -> Rotation:
    """Convert to the slot's value; `seen` (k, 3, 3) is R_camera_manhattan of each known frame, NaN where it is not in view."""
    return Rotation(
        index=index,
        stamp_ns=stamp_ns,
        R_world_camera=polar_rotation(np.array(estimate.R)),
        covariance=0.5 * (estimate.covariance + estimate.covariance.T),
        R_world_manhattan=known.R_world_manhattan,
        R_camera_manhattan=seen,
        ids=known.ids,
        weights=known.weights,
        source=estimate.source,
    )
