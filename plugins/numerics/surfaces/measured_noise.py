"""How noisy a depth image is, by its own planes: a data set does not always say what made it."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, U8, DepthNoise, Frame, Planes

COLUMNS = 160  # of readings that are asked
LEAST = 500  # of them on planes, below which the camera's model is believed
SIGMAS = 1.4826  # standard deviation of a normal distribution whose median distance from 0 is 1


def with_measured_noise(frame: Frame, planes: Planes) -> Frame:
    """The frame with its camera's depth noise scaled to what half of the readings on planes show of it; never above the camera's own, and never below
    its floor."""
    camera, noise = frame.camera, frame.camera.depth_noise
    lens = camera.intrinsics
    step = max(1, planes.labels.shape[1] // COLUMNS)
    off, depth = _off_planes(frame.depth_m, planes.labels, planes.coefficients, planes.stride, step, lens)
    if len(off) < LEAST:
        return frame
    scale = float(min(1.0, SIGMAS * np.median(off / noise.sigma_m(depth))))
    return replace(frame, camera=replace(camera, depth_noise=DepthNoise(scale * noise.a_m, scale * noise.b, scale * noise.c_per_m, noise.floor_m)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _off_planes(depth: F32, labels: U8, planes: F64, stride: int, step: int, lens: F64) -> tuple[F64, F64]:
    """How far readings (n,) are from their planes along their rays, and their depth."""
    h, w = labels.shape
    off, read, count = np.empty(h * w), np.empty(h * w), 0
    for r in range(0, h, step):
        for c in range(0, w, step):
            v, u = r * stride, c * stride
            if labels[r, c] == 0 or v >= depth.shape[0] or u >= depth.shape[1] or not depth[v, u] > 0.0:
                continue
            n = planes[labels[r, c] - 1]
            slope = n[0] * (u - lens[2]) / lens[0] + n[1] * (v - lens[3]) / lens[1] + n[2]
            if slope < 0.0:  # towards the camera
                off[count], read[count] = abs(depth[v, u] + n[3] / slope), depth[v, u]
                count += 1
    return off[:count], read[:count]
