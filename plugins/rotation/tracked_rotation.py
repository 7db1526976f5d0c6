"""The previous rotation composed with that measured by the tracks."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.linalg_kernels import solve_positive
from trihedron.pipeline.core.types import Camera, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.rotation.estimate import IDENTITY, Estimate
from trihedron.plugins.shared.relative_motion import MotionOptions, solve_motion


class TrackOptions(MotionOptions, Protocol):
    """Options of every plugin that measures the rotation by the tracks."""

    @property
    def measured_deg(self) -> float:
        """Standard deviation above which the tracks have not measured the rotation."""

    @property
    def predict_frames(self) -> int:
        """Number of frames without features for which the velocity is constant."""


def compose_with_tracks(
    options: TrackOptions,
    camera: Camera,
    before: Estimate,
    previous_index: int,
    tracks: Tracks | None,
    keypoints: Keypoints,
    segments: Segments,
    planes: Planes,
) -> Estimate:
    """Return the rotation of the frame of `keypoints`: that of frame `previous_index` composed with the motion of the tracks; see `solve_motion`.

    The source is "prediction" when the σ about some axis exceeds `measured_deg`. Without any support the rotation is predicted with constant velocity
    for `predict_frames`, then at rest; without tracks to the previous frame it is at rest, with a larger covariance."""
    gap = max(keypoints.index - previous_index, 1)
    if tracks is None or tracks.previous_index != previous_index:
        return Estimate(before.R, before.covariance + IDENTITY * math.radians(options.prior_deg * gap) ** 2, "prediction")
    motion = solve_motion(options, camera, tracks, keypoints, segments, planes, gap)
    added = motion.covariance[:3, :3]
    if motion.support == 0.0 and before.covariance.trace() / 3.0 >= options.predict_frames * math.radians(options.prior_deg) ** 2:  # long ago
        return Estimate(before.R, before.covariance + added, "prediction")
    measured = solve_positive(IDENTITY * math.radians(options.measured_deg) ** 2 - added, np.zeros(3), np.empty(3))  # smaller along every axis
    return Estimate(matmul(before.R, motion.R.T), matmul(motion.R, before.covariance, motion.R.T) + added, "tracks" if measured else "prediction")
