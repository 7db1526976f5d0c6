"""Parameters of a camera's calibration that are not known exactly, and what a pose's covariance owes to them.

They are consider parameters (Schmidt, 1966; Tapley, Schutz and Born, Statistical Orbit Determination, 2004, chapter 6): not estimated with the pose,
but counted in its covariance. Each is in units of `calibration_scales`, the standard deviation with which it is known (`Camera.sigmas`).

0, 1  focal lengths fx, fy, of colour and depth          7   offset of inverse depth
2, 3  principal point cx, cy, of both                    8   relative error of depth in the corners of the image, with the square of the radius
4     focal length of depth relative to colour           9   readout of colour, first row to last, about the middle row
5, 6  registration of depth to colour, x and y           10  delay of depth relative to colour
                                                         11  readout of depth

The scale of all depths leaves no residual, since the world and the way through it grow alike, so that it is none of these. Its part of a pose's error
is the position in the world times the scale's error.
"""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.registry import register_covariance
from trihedron.pipeline.core.types import F64, Camera, Pose
from trihedron.plugins.shared.calibration_error_kernels import calibration_moment

IMPRECISION = 0.2  # of sensitivities: of the motion by the calibration, what it is off by in any direction
CALIBRATION_NAMES = (
    "the focal length fx", "the focal length fy", "the principal point in x", "the principal point in y", "the focal length of depth",
    "the registration of depth in x", "the registration of depth in y", "inverse depth", "depth in the corners", "the readout of colour",
    "the delay of depth", "the readout of depth",
)  # fmt: skip


def calibration_scales(camera: Camera) -> F64:
    """Return the standard deviations (12,) with which the calibration of a camera is known: those that it states, by default the ranges that are
    published or usual, as in `datasets.simulation.sensor_models`."""
    known = camera.sigmas
    centre, shift = known.centre * camera.width, known.registration * camera.width
    return np.array([
        known.focal, known.focal, centre, centre, known.depth_focal, shift, shift, known.inverse_depth, known.depth_radial,
        known.readout_s, known.delay_s, known.depth_readout_s,
    ])  # fmt: skip


@register_covariance("calibration")
def calibration_covariance(pose: Pose) -> F64:
    """Covariance (6, 6) of a pose's error by the calibration, part of its `map_covariance`."""
    covariance = sensitivity_covariance(pose.sensitivity, pose.calibration_information, pose.calibration_score)
    scaled = pose.depth_scale_sigma * matmul(pose.T_world_camera[:3, :3].T, pose.T_world_camera[:3, 3])
    covariance[:3, :3] += np.outer(scaled, scaled)
    return covariance


def sensitivity_covariance(sensitivity: F64, information: F64, score: F64) -> F64:
    """Covariance (6, 6) of an error of the calibration's parameters times a `sensitivity` (6, 12), given the evidence of residuals, `information`
    (12, 12) and `score` (12,).

    The sensitivity is known to a share, `IMPRECISION`, by which position and rotation err in any direction: along its own columns alone the error
    would be taken to be exact in all others."""
    covariance = np.asarray(matmul(sensitivity, calibration_moment(information, score), sensitivity.T))
    variance = covariance.diagonal().reshape(2, 3).mean(axis=1)  # of position and rotation, each about one axis
    return covariance + np.diag(np.repeat(IMPRECISION**2 * variance, 3))
