"""Odometry between keyframes: their relative motion as it was tracked, with its covariance."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.types import F64, I32, Map

LEAST_M, LEAST = 1e-3, 1e-4  # standard deviations between two keyframes at one place, m and rad


def odometry(map: Map, pairs: I32, drift: float, rotation_drift: float, times: float = 1.0) -> tuple[F64, F64]:
    """Return the motions `T_a_b` (e, 4, 4) between pairs (e, 2) of keyframes, the earlier first, and the information (e, 6, 6) of their xi.

    The covariance is `times` that of the later keyframe's pose plus the drift along the path: standard deviations per square root of a metre, m and
    rad."""
    poses = map.keyframes.rows("T_world_camera", pairs.ravel()).reshape(-1, 2, 4, 4)
    motions = invert(poses[:, 0]) @ poses[:, 1]
    length = np.linalg.norm(motions[:, :3, 3], axis=1)[:, None, None]
    covariance = times * map.keyframes.rows("covariance", pairs[:, 1])
    covariance[:, :3, :3] += times * (drift**2 * length + LEAST_M**2) * np.eye(3)
    covariance[:, 3:, 3:] += times * (rotation_drift**2 * length + LEAST**2) * np.eye(3)
    return np.ascontiguousarray(motions), np.asarray(np.linalg.inv(covariance), np.float64)
