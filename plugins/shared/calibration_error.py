"""Parameters of a camera's calibration that are not known exactly, and what a pose's covariance owes to them.

They are consider parameters (Schmidt, 1966; Tapley, Schutz and Born, Statistical Orbit Determination, 2004, chapter 6): not estimated with the pose,
but counted in its covariance. Each is in units of `calibration_scales`, the standard deviation with which it is known of a camera of a kind: within
half a percent of the focal lengths, a few pixels of registration, a percent of a depth.

0, 1  focal lengths fx, fy, of colour and depth          7   offset of inverse depth
2, 3  principal point cx, cy, of both                    8   relative error of depth in the corners of the image, with the square of the radius
4     focal length of depth relative to colour           9   readout of colour, first row to last, about the middle row
5, 6  registration of depth to colour, x and y           10  delay of depth relative to colour
                                                         11  readout of depth
"""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.registry import register_covariance
from trihedron.pipeline.core.types import F64, Camera, Pose
from trihedron.plugins.shared.calibration_error_kernels import calibration_moment

FOCAL, CENTRE, REGISTRATION = 0.003, 0.0019, 0.0022  # of the focal length; of the image's width, twice
INVERSE_DEPTH_PER_M, RADIAL = 0.002, 0.007
CALIBRATION_NAMES = (
    "the focal length fx", "the focal length fy", "the principal point in x", "the principal point in y", "the focal length of depth",
    "the registration of depth in x", "the registration of depth in y", "inverse depth", "depth in the corners", "the readout of colour",
    "the delay of depth", "the readout of depth",
)  # fmt: skip
READOUT_S, DELAY_S, DEPTH_READOUT_S = 0.02, 0.012, 0.015


def calibration_scales(camera: Camera) -> F64:
    """Standard deviations (12,) with which the calibration of a camera of a kind is known: those of the ranges that are published or usual, as in
    `datasets.simulation.sensor_models`."""
    centre, shift = CENTRE * camera.width, REGISTRATION * camera.width
    return np.array([FOCAL, FOCAL, centre, centre, FOCAL, shift, shift, INVERSE_DEPTH_PER_M, RADIAL, READOUT_S, DELAY_S, DEPTH_READOUT_S])


@register_covariance("calibration")
def calibration_covariance(pose: Pose) -> F64:
    """Covariance (6, 6) of a pose's error by the calibration, part of its `map_covariance`."""
    moment = calibration_moment(pose.calibration_information, pose.calibration_score)
    return np.asarray(matmul(pose.sensitivity, moment, pose.sensitivity.T))
