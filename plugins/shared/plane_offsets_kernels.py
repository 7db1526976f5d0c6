"""Kernel of `plane_offsets.py`: how far an imperfect calibration takes the points of a plane from where the map has it."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import split_pose
from trihedron.pipeline.core.types import CALIBRATION, F32, F64, I32
from trihedron.plugins.shared.calibration_error_kernels import Keyframes, in_view, plane_point_error, to_keyframe, to_observers
from trihedron.plugins.shared.residuals_kernels import to_camera


@kernel(forceinline=True)
def _add_error(E: F64, scales: F64, J: F64, of_pose: F64, out: F64) -> None:
    """Add to `out` (12,) the error of a distance: E (12,) by the measurement, in units of `scales`, and by that `of_pose` (6, 12)."""
    for c in range(CALIBRATION):
        out[c] += E[c] * scales[c]
        for a in range(6):
            out[c] += J[a] * of_pose[a, c]


@kernel
def distance_sigmas(
    T: F64, camera: F64, width: int, height: int, scales: F64, twist: F64, sensitivity: F64, moment: F64, planes: F64, samples: F32, observers: I32,
    keyframes: Keyframes,
) -> F64:  # fmt: skip
    """Standard deviations (m, s), by the calibration, of the distances (m) of samples (m, s, 3), in the camera's frame, from the planes (m, 4) of the
    map that they were matched with; NaN for those that none of the plane's `observers` (m, o) had in its image.

    A sample errs by the calibration, less the mean error of what its observers saw of the plane there, and by the error of the pose, less theirs."""
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
            J[0], J[1], J[2] = now[0], now[1], now[2]
            J[3], J[4], J[5] = p[1] * now[2] - p[2] * now[1], p[2] * now[0] - p[0] * now[2], p[0] * now[1] - p[1] * now[0]
            for a in range(3):
                world[a] = R[a, 0] * p[0] + R[a, 1] * p[1] + R[a, 2] * p[2] + t[a]
            error[:], count = 0.0, 0
            for o in range(observers.shape[1]):
                k = observers[i, o]
                if k < 0:
                    continue
                to_camera(keyframes.R[k], keyframes.t[k], world, q)
                if in_view(q, camera, width, height):
                    plane_point_error(q, then[o], keyframes.twists[k], camera, width, height, E)
                    _add_error(E, scales, J, keyframes.errors[k], error)
                    count += 1
            if count == 0:
                continue
            plane_point_error(p, now, twist, camera, width, height, E)
            for c in range(CALIBRATION):
                error[c] /= -count
            _add_error(E, scales, J, sensitivity, error)
            variance = 0.0
            for c in range(CALIBRATION):
                for d in range(CALIBRATION):
                    variance += error[c] * moment[c, d] * error[d]
            out[i, j] = np.sqrt(max(variance, 0.0))
    return out
