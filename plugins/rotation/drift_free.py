"""The camera's rotation fused from the scene's Manhattan frames and the tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.lie import exp_so3, log_so3
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.linalg_kernels import inverse_positive, solve_positive
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Camera, Keypoints, ManhattanFrame, Map, Planes, Pose, Rotation, Segments, Tracks
from trihedron.plugins.mapping.reference_keyframe import transform_rotation_to_map
from trihedron.plugins.rotation.estimate import IDENTITY, Estimate, rotation_before, rotation_value
from trihedron.plugins.rotation.known_frames import KnownFrames, Observation
from trihedron.plugins.rotation.tracked_rotation import compose_with_tracks


@register("rotation", "drift_free")
@dataclass(frozen=True)
class DriftFree:
    """`R_world_camera = R_world_manhattan · R_camera_manhattanᵀ` (eq. 1), fused by covariance with the previous rotation composed with
    that of the tracks.

    The tracks are accurate from frame to frame and drift; the Manhattan frame does not drift and is coarser. Where no Manhattan frame is supported,
    or the observed one disagrees with the tracks, the tracks are propagated alone and their covariance grows, so that a Manhattan frame that returns
    dominates gradually. One that disagrees becomes a new known frame. The world–Manhattan rotations are re-estimated from refined poses."""

    unit_deg: PositiveFloat = 0.3  # an observation of R_world_manhattan with this standard deviation counts as one
    max_weight: Annotated[float, Range(1)] = 300.0  # observations; more do not make it stiffer
    correlation: Annotated[float, Range(1)] = 10.0  # successive errors are correlated: so many observations count as one in its covariance
    axis_floor_deg: PositiveFloat = 0.1  # least error of R_world_manhattan
    pose_floor_deg: PositiveFloat = 0.1  # least error of the previous pose: the map drifts, which its covariance does not include
    gate: PositiveFloat = 4.0  # standard deviations between tracks and Manhattan frame
    gate_floor_deg: PositiveFloat = 0.7  # least standard deviation of that difference
    step_deg: PositiveFloat = 0.5  # most that a Manhattan frame corrects rotations from tracks in one frame: no jump
    min_observations: float = 3.0  # frames observed less often are removed when out of view
    max_frames: PositiveInt = 6  # Manhattan frames remembered
    prior_deg: PositiveFloat = 2.0  # of the predicted rotation, per frame
    prior_m: PositiveFloat = 0.1  # of the motion, per frame
    measured_deg: PositiveFloat = 1.0  # tracks that leave the rotation less certain than this have not measured it
    angle_px: PositiveFloat = 0.002  # rad, of a pixel
    plane_floor_deg: PositiveFloat = 0.3  # error of a tracked plane's normal
    predict_frames: NonNegativeInt = 15  # half a second without features: a hand-held camera's velocity is not constant for longer

    def __call__(
        self,
        camera: Camera,
        manhattan: ManhattanFrame | None,
        tracks: Tracks | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous: Rotation | None,
        previous_pose: Pose | None,
        map: Map | None,
    ) -> Rotation:
        """Return the rotation of this frame; the identity for the first."""
        known, predicted = KnownFrames.none(), Estimate(np.eye(3), np.zeros((3, 3)), "prediction")
        if previous is not None:
            previous, previous_pose = transform_rotation_to_map(previous, previous_pose, map)
            before, refined = rotation_before(previous, previous_pose, self.pose_floor_deg)
            known = KnownFrames(previous.R_world_manhattan, previous.ids, previous.weights)
            if refined:
                known = known.update(previous, before.R, self.max_weight, self.gate * math.radians(self.gate_floor_deg))
            predicted = compose_with_tracks(self, camera, before, previous.index, tracks, keypoints, segments, planes)
        known, estimate, seen = self._fuse(known, predicted, manhattan)
        return rotation_value(keypoints.index, keypoints.stamp_ns, estimate, known, seen)

    def _fuse(self, known: KnownFrames, predicted: Estimate, manhattan: ManhattanFrame | None) -> tuple[KnownFrames, Estimate, F64]:
        """Fuse the prediction with the observed Manhattan frames; also the known frames with new ones appended, and R_camera_manhattan of each."""
        estimate = predicted
        observations: dict[int, F64] = {}
        for k, row in known.associations(manhattan, predicted.R):
            noises = [self._noise(s, known) for s in row]
            distances = [self._distance(s.delta, noise, predicted) for s, noise in zip(row, noises, strict=True)]
            best = min(range(len(row)), key=distances.__getitem__, default=-1)
            if row and distances[best] < self.gate and best not in observations:
                estimate = self._kalman_update(estimate, predicted, row[best].delta, noises[best])
                observations[best] = row[best].R_camera_manhattan
            elif manhattan is not None and len(known.ids) < self.max_frames:
                certain = math.radians(self.unit_deg) ** 2 / (np.trace(predicted.covariance + manhattan.covariance[k]) / 3.0 + 1e-12)
                known = known.with_new(matmul(predicted.R, manhattan.rotations[k]), min(certain, 1.0))
                observations[len(known.ids) - 1] = manhattan.rotations[k]
        keep = [i for i in range(len(known.ids)) if i in observations or known.weights[i] >= self.min_observations]
        seen = np.array([observations.get(i, np.full((3, 3), np.nan)) for i in keep]).reshape(-1, 3, 3)
        return known.select(np.array(keep, np.intp)), estimate, seen

    def _noise(self, observation: Observation, known: KnownFrames) -> F64:
        """Covariance (3, 3) of an observed rotation: its own and that of R_world_manhattan."""
        weight = known.weights[observation.row]
        independent = max(weight / self.correlation, min(weight, 1.0))
        axes = math.radians(self.unit_deg) ** 2 / independent + math.radians(self.axis_floor_deg) ** 2
        return np.asarray(observation.covariance + axes * IDENTITY)

    def _distance(self, delta: F64, noise: F64, predicted: Estimate) -> float:
        """Mahalanobis distance between an observation and the prediction."""
        whitened = np.empty(3)
        solve_positive(noise + predicted.covariance + IDENTITY * math.radians(self.gate_floor_deg) ** 2, delta, whitened)
        return math.sqrt(matmul(delta, whitened))

    def _kalman_update(self, estimate: Estimate, predicted: Estimate, delta: F64, noise: F64) -> Estimate:
        """Kalman update of the estimate by an observation; both covariances are of rotations of the camera."""
        gain = matmul(estimate.covariance, inverse_positive(estimate.covariance + noise))
        covariance = matmul(gain, noise)
        step = matmul(gain, log_so3(matmul(estimate.R.T, predicted.R, exp_so3(delta))))
        length = math.hypot(*step.tolist())
        limit = math.radians(self.step_deg)
        if predicted.source == "tracks" and length > limit:  # the rest is left for the next frames, and added to the covariance
            rest = (1.0 - limit / length) * step
            covariance, step = covariance + rest[:, None] * rest, step - rest
        return Estimate(matmul(estimate.R, exp_so3(step)), covariance, "manhattan")
