"""The known Manhattan frames, as rotations to the world with the number of observations of each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.lie import exp_so3, log_so3
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.linalg_kernels import polar_rotation
from trihedron.pipeline.core.types import F64, I32, ManhattanFrame, Rotation
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent


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

    def update(self, previous: Rotation, R_world_camera: F64, cap: float, gate: float) -> KnownFrames:
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
