"""Kernel of `plane_offsets.py`: how far an imperfect calibration takes the points of a plane from where the map has it."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import split_pose
from trihedron.pipeline.core.types import CALIBRATION, F32, F64, I32
from trihedron.plugins.shared.calibration_error_kernels import (
    Keyframes,
    distance_jacobian,
    in_view,
    placed_distance_error,
    plane_point_error,
    to_keyframe,
    to_observers,
)


@kernel
def distance_sigmas(
    T: F64, camera: F64, width: int, height: int, scales: F64, twist: F64, sensitivity: F64, moment: F64, planes: F64, samples: F32, observers: I32,
    keyframes: Keyframes,
) -> F64:  # fmt: skip
    """Standard deviations (m, s), by the calibration, of the distances (m) of samples (m, s, 3), in the camera's frame, from the planes (m, 4) of the
    map that they were matched with; NaN for those that none of the plane's `observers` (m, o) had in its image.

    A sample errs by the calibration, less the mean error of what its observers saw of the plane there, weighted by their noise of depth, and by
    the error of the pose, less theirs."""
    R, t = split_pose(T)
    out = np.full(samples.shape[:2], np.nan)
    now, then, p, q, world, J = np.empty(4), np.empty((observers.shape[1], 4)), np.empty(3), np.empty(3), np.empty(3), np.empty(6)
    E, error = np.empty(CALIBRATION), np.empty(CALIBRATION)
    for i in range(len(planes)):
        to_keyframe(R, t, planes[i], now)
        to_observers(keyframes, observers[i], planes[i], then)
        for j in range(samples.shape[1]):
            for a in range(3):
                p[a] = samples[i, j, a]
            if not in_view(p, camera, width, height):
                continue
            distance_jacobian(now, p, J)
            for a in range(3):
                world[a] = R[a, 0] * p[0] + R[a, 1] * p[1] + R[a, 2] * p[2] + t[a]
            if not placed_distance_error(world, J, observers[i], keyframes, then, camera, width, height, scales, q, E, error):
                continue
            plane_point_error(p, now, twist, camera, width, height, E)
            for c in range(CALIBRATION):
                error[c] = E[c] * scales[c] - error[c]
                for a in range(6):
                    error[c] += J[a] * sensitivity[a, c]
            variance = 0.0
            for c in range(CALIBRATION):
                for d in range(CALIBRATION):
                    variance += error[c] * moment[c, d] * error[d]
            out[i, j] = np.sqrt(max(variance, 0.0))
    return out
