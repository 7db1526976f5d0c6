"""The error, by the calibration of the camera, of where a keyframe is registered at a place that it comes back to.

The keyframes of the place and the newest one see the same landmarks from different poses, at different pixels, ranges and velocities. A wrong focal
length moves what they measure by different amounts, by centimetres two metres apart, while the noise of the registration is some millimetres."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.types import CALIBRATION, F64, Camera, Map, Matches
from trihedron.plugins.shared.calibration_error import calibration_scales
from trihedron.plugins.shared.calibration_error_kernels import Observers, Surfaces, calibration_equations, keyframes_at, sensitivity_and_evidence
from trihedron.plugins.shared.pose_optimizer import PoseSolution, Terms
from trihedron.plugins.shared.pose_optimizer_kernels import Flags


def registration_error(map: Map, camera: Camera, matches: Matches, terms: Terms, found: PoseSolution, information: F64) -> F64:
    """Return the error (6, 12) of the pose of the newest keyframe by each parameter of the calibration, in units of `calibration_scales`, as that of
    xi of the camera, where the keyframes that observed the matched landmarks have none.

    `terms` are those of the matches from which the pose was `found`, `information` (6, 6) is that of its prior."""
    T, newest = constant(found.T_world_camera, np.float64), len(map.keyframes) - 1
    observed = Observers(
        map.points.rows("observers", matches.keypoints[:, 1]),
        map.lines.rows("observers", matches.segments[:, 1]),
        map.planes.rows("observers", matches.planes[:, 1]),
    )
    poses, twists = map.keyframes.columns_at(np.arange(newest + 1), "T_world_camera", "twist")
    keyframes = keyframes_at(T, poses, constant(twists, np.float64), np.zeros((newest + 1, 6, CALIBRATION)), camera.depth_noise.coefficients)
    unknown = Surfaces(np.full((len(matches.keypoints), 4), np.nan), np.full((len(matches.segments), 2, 4), np.nan))
    equations = calibration_equations(
        T, camera.intrinsics, camera.width, camera.height, calibration_scales(camera), constant(twists[-1], np.float64), *terms,
        Flags(found.points, found.lines, found.planes), unknown, map.planes.rows("samples_m", matches.planes[:, 1]), observed, keyframes,
    )  # fmt: skip
    return sensitivity_and_evidence(equations, information, np.zeros((6, CALIBRATION)))[0]
