"""The rotation of a frame on top of the previous one's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64, LOST, Keypoints, Planes, Pose, Rotation, Segments, Tracks
from trihedron.plugins.numerics.algebra.small_linear import polar_rotation, solve_positive
from trihedron.plugins.numerics.axes.manhattan_frames import KnownFrames
from trihedron.plugins.numerics.motion.relative_motion import solve_motion

IDENTITY = np.eye(3)


@dataclass(frozen=True)
class Estimate:
    """A rotation R_world_camera (3, 3), the covariance of phi in `R · Exp(phi)` (3, 3) and where it comes from (manhattan | tracks | prediction)."""

    R: F64
    covariance: F64
    source: str


def rotation_before(previous: Rotation, previous_pose: Pose | None, floor_deg: float) -> tuple[Estimate, bool]:
    """The previous frame's rotation, and whether it is its refined pose's; `floor_deg` is the least error of that, since the map it was refined
    against drifts, which its covariance does not know."""
    if previous_pose is not None and previous_pose.index == previous.index and previous_pose.status != LOST:
        floor = IDENTITY * math.radians(floor_deg) ** 2
        return Estimate(previous_pose.T_world_camera[:3, :3], previous_pose.covariance[3:, 3:] + floor, previous.source), True
    return Estimate(previous.R_world_camera, previous.covariance, previous.source), False


@dataclass(frozen=True)
class TrackedRotation:
    """Puts the rotation that the tracks measure on top of the previous one; see `solve_motion` for the constants. Source "prediction" when the
    tracks leave some axis less certain than `measured_deg`; where they say nothing at all the camera turns on for `predict_frames`, then stands."""

    prior_deg: float
    prior_m: float
    measured_deg: float
    angle_px: float
    plane_floor_deg: float
    predict_frames: int

    def __call__(
        self, before: Estimate, previous_index: int, tracks: Tracks | None, keypoints: Keypoints, segments: Segments, planes: Planes
    ) -> Estimate:
        """The rotation of the frame of `keypoints`; that of frame `previous_index`, less certain, when the tracks do not reach it."""
        gap = max(keypoints.index - previous_index, 1)
        if tracks is None or tracks.previous_index != previous_index:
            return Estimate(before.R, before.covariance + IDENTITY * math.radians(self.prior_deg * gap) ** 2, "prediction")
        motion = solve_motion(tracks, keypoints, segments, planes, self.angle_px, self.plane_floor_deg, self.prior_deg * gap, self.prior_m * gap)
        turned = motion.covariance[:3, :3]
        if motion.support == 0.0 and before.covariance.trace() / 3.0 >= self.predict_frames * math.radians(self.prior_deg) ** 2:  # long ago
            return Estimate(before.R, before.covariance + turned, "prediction")
        measured = solve_positive(IDENTITY * math.radians(self.measured_deg) ** 2 - turned, np.zeros(3), np.empty(3))  # smaller along every axis
        return Estimate(before.R @ motion.R.T, motion.R @ before.covariance @ motion.R.T + turned, "tracks" if measured else "prediction")


def rotation_value(index: int, stamp_ns: int, estimate: Estimate, known: KnownFrames, seen: F64) -> Rotation:
    """As the slot's value; `seen` (k, 3, 3) is R_camera_manhattan of each known frame, NaN where it is not in view."""
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
