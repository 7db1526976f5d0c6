"""The camera's rotation from the Manhattan frame alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Keypoints, ManhattanFrame, Rotation
from trihedron.plugins.rotation.estimate import Estimate, rotation_value
from trihedron.plugins.rotation.known_frames import KnownFrames
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent

UNSEEN = np.full((1, 3, 3), np.nan)


@register("rotation", "manhattan")
@dataclass(frozen=True)
class ManhattanRotation:
    """`R_world_camera = R_world_manhattan · R_camera_manhattanᵀ` (eq. 1) with the R_world_manhattan of the first frame that shows one, as OPVO (Kim,
    Coltin, Kim, BMVC 2017), LPVO (ICRA 2018) and L-SLAM (ECCV 2018) have it: absolute, so it does not drift.

    Where no Manhattan frame is supported the rotation is held, with growing covariance (`source` prediction)."""

    held_deg: PositiveFloat = 2.0  # error of a rotation that is held, per frame

    def __call__(self, manhattan: ManhattanFrame | None, keypoints: Keypoints, previous: Rotation | None) -> Rotation:
        """Return the rotation of this frame; the identity for the first."""
        index, known = keypoints.index, KnownFrames.none()
        held = Estimate(np.eye(3), np.zeros((3, 3)), "prediction")
        if previous is not None:
            grown = np.eye(3) * np.radians(self.held_deg) ** 2 * max(index - previous.index, 1)
            held = Estimate(previous.R_world_camera, previous.covariance + grown, "prediction")
            known = KnownFrames(previous.R_world_manhattan, previous.ids, previous.weights)
        if manhattan is None or not manhattan.supported:
            return rotation_value(index, keypoints.stamp_ns, held, known, UNSEEN[: len(known.ids)].copy())
        R_camera_manhattan = np.array(manhattan.rotations[0])
        if not len(known.ids):
            known = known.with_new(matmul(held.R, R_camera_manhattan), 1.0)
            return rotation_value(index, keypoints.stamp_ns, held, known, R_camera_manhattan[None])
        nearest = nearest_equivalent(R_camera_manhattan, np.array(matmul(held.R.T, known.R_world_manhattan[0])))
        estimate = _absolute(known.R_world_manhattan[0], nearest, manhattan.covariance[0])
        return rotation_value(index, keypoints.stamp_ns, estimate, known, nearest[None])


def _absolute(R_world_manhattan: F64, R_camera_manhattan: F64, covariance: F64) -> Estimate:
    return Estimate(matmul(R_world_manhattan, R_camera_manhattan.T), covariance, "manhattan")
