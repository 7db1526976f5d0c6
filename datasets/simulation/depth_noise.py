"""Noise of depth cameras, added to exact images: axial noise, ragged edges, shadows, quantised disparity, holes, image noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit

from trihedron.pipeline.core.types import F32, F64, U8, DepthNoise


@dataclass(frozen=True)
class DepthSensor:
    """A camera that triangulates: standard deviation of its depth; the baseline between camera and projector, or between its two cameras; what depth
    is counted in, steps of disparity of one metre; the blur of its errors, as it matches windows, so neighbouring errors are alike."""

    noise: DepthNoise
    baseline_m: float
    steps_m: float
    correlation_px: float  # Gaussian blur of white noise
    range_m: tuple[float, float]


# Khoshelham and Elberink 2012: 0.075 m, 580 px of the infrared camera, eighths of a pixel.
KINECT = DepthSensor(DepthNoise(), 0.075, 43.5 * 8.0, 0.8, (0.4, 8.0))
# As an Intel D435: 50 mm, 635 px at 848 pixels' width, 0.1 px of subpixel error, thirty-seconds of a pixel.
STEREO = DepthSensor(DepthNoise(0.0, 0.0, 0.00315, 0.001), 0.05, 0.05 * 635.0 * 32.0, 1.6, (0.3, 8.0))
GRAZING, GRAZING_SPREAD = 0.14, 0.05  # cosine of incidence below which depth is lost, about 82°, and how ragged that limit is
EDGE_SHARE = 0.03  # a depth jump above this share of z is an edge
SHIFTS = np.repeat(np.arange(-2, 3), (4, 58, 132, 58, 4)).astype(np.int8)  # 256 lateral shifts with σ 0.75 px (Nguyen et al. 2012: 0.8 to 0.9)
IMAGE_SIGMA = 1.5  # grey levels


def kinect_depth(depth_m: F64, cosine: F32, fx: float, noise: DepthNoise, rng: np.random.Generator) -> F32:
    """Return the depth that a Kinect of another `noise` senses, as `sensed_depth`."""
    return sensed_depth(depth_m, cosine, fx, replace(KINECT, noise=noise), rng)


def sensed_depth(depth_m: F64, cosine: F32, fx: float, sensor: DepthSensor, rng: np.random.Generator) -> F32:
    """Exact (h, w) depth and cosine of incidence -> (h, w) sensed depth in metres, 0 = none.

    Away from edges the standard deviation, quantisation included, is that of the sensor's noise."""
    h, w = depth_m.shape
    noise, size = sensor.noise, 2 * math.ceil(3.0 * sensor.correlation_px) + 1
    kernel = cv2.getGaussianKernel(size, sensor.correlation_px)
    white = rng.standard_normal((h, w), dtype=np.float32)
    correlated = np.asarray(cv2.sepFilter2D(white, -1, kernel, kernel)) * np.float32(1.0 / np.sum(kernel**2))
    shifts = rng.integers(0, 256, size=(2, h, w), dtype=np.uint8)
    sensed = np.empty((h, w), dtype=np.float32)
    model = np.array([*noise.coefficients, sensor.steps_m, *sensor.range_m])
    _sense(depth_m, cosine, correlated, shifts, fx * sensor.baseline_m, model, sensed)
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
            lost = shadowed or z < model[5] or z > model[6] or cosine[y, x] < GRAZING + GRAZING_SPREAD * normal[y, x]
            sensed[y, x] = 0.0 if lost else _read(z, normal[y, x], model)


@njit(cache=True, nogil=True, error_model="numpy")
def _read(z: float, normal: float, model: F64) -> float:
    """Add noise of the model's σ less the share of the quantisation, then quantise the disparity."""
    sigma = max(model[3], model[0] + model[1] * z + model[2] * z * z)
    step = z * z / model[4]
    noisy = z + normal * math.sqrt(max(0.0, sigma * sigma - step * step / 12.0))
    steps = round(model[4] / max(noisy, 0.1))
    return float(model[4] / max(steps, 1.0))


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
