"""Noise of a Kinect-like sensor, added to exact images: axial noise, ragged edges, projector shadows, quantised disparity, holes, image noise."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit

from trihedron.pipeline.core.types import F32, F64, U8, DepthNoise

RANGE_M = (0.4, 8.0)
BASELINE_M = 0.075  # between camera and projector (Khoshelham and Elberink 2012)
BASELINE_FOCAL_PX_M = 43.5  # 0.075 m × 580 px of the infrared camera
DISPARITY_STEPS_PER_PX = 8.0  # the 11-bit disparity counts eighths of a pixel
CORRELATION_PX = 0.8  # the sensor matches windows, so neighbouring errors are alike: Gaussian blur of white noise
GRAZING, GRAZING_SPREAD = 0.14, 0.05  # cosine of incidence below which depth is lost, about 82°, and how ragged that limit is
EDGE_SHARE = 0.03  # a depth jump above this share of z is an edge
SHIFTS = np.repeat(np.arange(-2, 3), (4, 58, 132, 58, 4)).astype(np.int8)  # 256 lateral shifts with σ 0.75 px (Nguyen et al. 2012: 0.8 to 0.9)
IMAGE_SIGMA = 1.5  # grey levels


def kinect_depth(depth_m: F64, cosine: F32, fx: float, noise: DepthNoise, rng: np.random.Generator) -> F32:
    """Exact (h, w) depth and cosine of incidence -> (h, w) sensed depth in metres, 0 = none.

    Away from edges the standard deviation, quantisation included, is that of `noise`."""
    h, w = depth_m.shape
    kernel = cv2.getGaussianKernel(7, CORRELATION_PX)
    white = rng.standard_normal((h, w), dtype=np.float32)
    correlated = np.asarray(cv2.sepFilter2D(white, -1, kernel, kernel)) * np.float32(1.0 / np.sum(kernel**2))
    shifts = rng.integers(0, 256, size=(2, h, w), dtype=np.uint8)
    sensed = np.empty((h, w), dtype=np.float32)
    model = np.array([noise.a_m, noise.b, noise.c_per_m, noise.floor_m])
    _sense(depth_m, cosine, correlated, shifts, fx * BASELINE_M, model, sensed)
    return sensed


@njit(cache=True, nogil=True, error_model="numpy")
def _sense(depth: F64, cosine: F32, normal: F32, shifts: U8, baseline_px_m: float, model: F64, sensed: F32) -> None:
    h, w = depth.shape
    for y in range(h):
        leftmost = np.inf  # of the projector's columns that are lit so far, from the right
        for x in range(w - 1, -1, -1):
            column = x - baseline_px_m / depth[y, x]
            shadowed = column > leftmost + 0.5
            leftmost = min(leftmost, column)
            z = depth[y, x]
            other = depth[min(max(y + SHIFTS[shifts[0, y, x]], 0), h - 1), min(max(x + SHIFTS[shifts[1, y, x]], 0), w - 1)]
            if abs(other - z) > EDGE_SHARE * z:
                z = other
            lost = shadowed or z < RANGE_M[0] or z > RANGE_M[1] or cosine[y, x] < GRAZING + GRAZING_SPREAD * normal[y, x]
            sensed[y, x] = 0.0 if lost else _read(z, normal[y, x], model)


@njit(cache=True, nogil=True, error_model="numpy")
def _read(z: float, normal: float, model: F64) -> float:
    """Add noise of the model's σ less the share of the quantisation, then quantise the disparity."""
    sigma = max(model[3], model[0] + model[1] * z + model[2] * z * z)
    step = z * z / (BASELINE_FOCAL_PX_M * DISPARITY_STEPS_PER_PX)
    noisy = z + normal * math.sqrt(max(0.0, sigma * sigma - step * step / 12.0))
    steps = round(BASELINE_FOCAL_PX_M * DISPARITY_STEPS_PER_PX / max(noisy, 0.1))
    return BASELINE_FOCAL_PX_M * DISPARITY_STEPS_PER_PX / max(steps, 1.0)


def noisy_color(color: U8, rng: np.random.Generator) -> U8:
    """(h, w, 3) RGB with Gaussian brightness noise of IMAGE_SIGMA grey levels."""
    out = np.empty_like(color)
    _brighten(color, rng.standard_normal(color.shape[:2], dtype=np.float32), out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _brighten(color: U8, normal: F32, out: U8) -> None:
    h, w, _ = color.shape
    for y in range(h):
        for x in range(w):
            for c in range(3):
                out[y, x, c] = np.uint8(min(255.0, max(0.0, color[y, x, c] + IMAGE_SIGMA * normal[y, x] + 0.5)))
