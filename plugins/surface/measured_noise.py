"""The noise of a depth image by its own planes: a data set does not always say what made it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.types import DepthNoise, Frame, Planes
from trihedron.plugins.surface.measured_noise_kernels import off_planes

COLUMNS = 160  # of readings that are asked
LEAST = 500  # of them on planes, below which the camera's model is believed
MAD_TO_SIGMA = 1.4826  # standard deviation of a normal distribution whose median distance from 0 is 1


def with_measured_noise(frame: Frame, planes: Planes) -> Frame:
    """The frame with its camera's depth noise scaled to what half of the readings on planes show of it; never above the camera's own, and never below
    its floor."""
    camera, noise = frame.camera, frame.camera.depth_noise
    intrinsics = camera.intrinsics
    step = max(1, planes.labels.shape[1] // COLUMNS)
    off, depth = off_planes(frame.depth_m, planes.labels, planes.coefficients, planes.stride, step, intrinsics)
    if len(off) < LEAST:
        return frame
    scale = float(min(1.0, MAD_TO_SIGMA * np.median(off / noise.sigma_m(depth))))
    return replace(frame, camera=replace(camera, depth_noise=DepthNoise(scale * noise.a_m, scale * noise.b, scale * noise.c_per_m, noise.floor_m)))
