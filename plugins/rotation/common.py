"""The rotation of a frame on top of the previous one's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.lie import exp_so3, log_so3
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.linalg_kernels import polar_rotation, solve_positive
from trihedron.pipeline.core.types import F64, I32, LOST, Keypoints, ManhattanFrame, Planes, Pose, Rotation, Segments, Tracks
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent
from trihedron.plugins.shared.relative_motion import solve_motion

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


@dataclass(frozen=True)
class TrackedRotation:
    """Compose the previous rotation with that measured by the tracks; see `solve_motion` for the options.

    The source is "prediction" when the σ about some axis exceeds `measured_deg`; without any support the rotation is predicted with constant velocity
    for `predict_frames`, then at rest."""

    prior_deg: float
    prior_m: float
    measured_deg: float
    angle_px: float
    plane_floor_deg: float
    predict_frames: int

    def __call__(
        self, before: Estimate, previous_index: int, tracks: Tracks | None, keypoints: Keypoints, segments: Segments, planes: Planes
    ) -> Estimate:
        """Return the rotation of the frame of `keypoints`; that of frame `previous_index`, with a larger covariance, without tracks to it."""
        gap = max(keypoints.index - previous_index, 1)
        if tracks is None or tracks.previous_index != previous_index:
            return Estimate(before.R, before.covariance + IDENTITY * math.radians(self.prior_deg * gap) ** 2, "prediction")
        motion = solve_motion(tracks, keypoints, segments, planes, self.angle_px, self.plane_floor_deg, self.prior_deg * gap, self.prior_m * gap)
        added = motion.covariance[:3, :3]
        if motion.support == 0.0 and before.covariance.trace() / 3.0 >= self.predict_frames * math.radians(self.prior_deg) ** 2:  # long ago
            return Estimate(before.R, before.covariance + added, "prediction")
        measured = solve_positive(IDENTITY * math.radians(self.measured_deg) ** 2 - added, np.zeros(3), np.empty(3))  # smaller along every axis
        return Estimate(matmul(before.R, motion.R.T), matmul(motion.R, before.covariance, motion.R.T) + added, "tracks" if measured else "prediction")


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


# The known Manhattan frames, as rotations to the world with the number of observations of each.


@dataclass(frozen=True)
class Observation:
    """Observation of a Manhattan frame, associated with the known frame in row `row`: `R_camera_manhattan` in that frame's order of the axes,
    covariance (3, 3) of phi in `R = Exp(phi) R_camera_manhattan`, and delta (3,) with
    `R_world_camera(Manhattan) = R_world_camera(predicted) · Exp(delta)`."""

    row: int
    R_camera_manhattan: F64
    covariance: F64
    delta: F64


@dataclass(frozen=True)
class KnownFrames:
    """k frames: `R_world_manhattan` (k, 3, 3), `ids` (k,), `weights` (k,) observations."""

    R_world_manhattan: F64
    ids: I32
    weights: F64

    @staticmethod
    def none() -> KnownFrames:
        """No known frame."""
        return KnownFrames(np.zeros((0, 3, 3)), np.zeros(0, np.int32), np.zeros(0))

    def updated_by(self, previous: Rotation, R_world_camera: F64, cap: float, gate: float) -> KnownFrames:
        """Update by the previous frame's observations at its refined rotation: the mean on SO(3) of all observations.

        Weights are limited to `cap`, so that the mean can follow a map that moves; observations off by more than `gate` (rad) are rejected."""
        rotations, weights = self.R_world_manhattan.copy(), self.weights.copy()
        for i in np.flatnonzero(np.isfinite(previous.R_camera_manhattan[:, 0, 0])):
            step = log_so3(matmul(rotations[i].T, R_world_camera, previous.R_camera_manhattan[i]))
            if math.hypot(*step.tolist()) < gate:
                weights[i] = min(weights[i] + 1.0, cap)
                rotations[i] = polar_rotation(matmul(rotations[i], exp_so3(step / weights[i])))
        return KnownFrames(rotations, self.ids, weights)

    def associations(self, manhattan: ManhattanFrame | None, R_world_camera: F64) -> list[tuple[int, list[Observation]]]:
        """All associations of each observed frame (row) with the known ones, axes ordered nearest to the predicted rotation.

        A frame that the estimator propagates without inliers is not observed."""
        if manhattan is None or not manhattan.supported:
            return []
        found = []
        for k in np.flatnonzero(manhattan.inliers.any(axis=1)):
            row = []
            for i, R_world_manhattan in enumerate(self.R_world_manhattan):
                named = nearest_equivalent(np.array(manhattan.rotations[k]), np.array(matmul(R_world_camera.T, R_world_manhattan)))
                row.append(Observation(i, named, manhattan.covariance[k], log_so3(matmul(R_world_camera.T, R_world_manhattan, named.T))))
            found.append((int(k), row))
        return found

    def with_new(self, R_world_manhattan: F64, weight: float) -> KnownFrames:
        """Append a frame whose first observation counts as `weight`."""
        number = int(self.ids.max(initial=-1)) + 1
        return KnownFrames(
            np.concatenate([self.R_world_manhattan, R_world_manhattan[None]]),
            np.append(self.ids, number).astype(np.int32),
            np.append(self.weights, weight),
        )

    def select(self, keep: I32) -> KnownFrames:
        """Select rows."""
        return KnownFrames(self.R_world_manhattan[keep], self.ids[keep], self.weights[keep])
