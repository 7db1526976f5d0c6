"""Depth as other sensors than a Kinect measure it: time of flight, active stereo, a telephone's lidar. Depth in metres, 0 = none."""

from __future__ import annotations

import cv2
import numpy as np

from trihedron.pipeline.core.types import F32, F64, U8, Bool

TOF_RANGE_M, TOF_FLOOR_M, TOF_PER_M2, DARK = (
    (0.25, 6.0),
    0.0015,
    0.0012,
    0.06,
)  # noise grows with range² over the amplitude; DARK returns nothing far off
WIGGLE_M, WIGGLE_PERIOD_M = 0.003, 0.75  # systematic error of a modulated signal
FLYING_JUMP, FLYING_SHARE = 0.04, 0.6  # a relative jump between neighbours; the share of its pixels that report a mean of both sides
STEREO_RANGE_M, STEREO_BASELINE_M, SUBPIXEL_PX, STEREO_STEPS = (0.3, 10.0), 0.05, 0.08, 32.0  # disparities count 1/32 px
STEREO_WINDOW_PX, FATTENED_PX, GRAY_NOISE = 3.0, 5, 1.5
PROJECTED, LEAST_TEXTURE, TEXTURE_WINDOW_PX = 20.0, 2.2, 9  # contrast in grey levels: of the projector's dots at 1 m, and the least that is matched
LIDAR_WIDTH, LIDAR_RANGE_M, LIDAR_SHARE, LIDAR_FLOOR_M = 256, (0.2, 5.0), 0.004, 0.002
LIDAR_CORRELATION_PX, LIDAR_SCALE, LIDAR_PERIOD_S = 4.0, 0.003, 11.0  # the scale of all depths wanders


def tof_depth(depth_m: F64, cosine: F32, gray: U8, noise: float, rng: np.random.Generator) -> F32:
    """Time of flight: noise over the square root of the returned amplitude, wiggling error, flying pixels, nothing from what is dark and far."""
    amplitude = np.maximum(gray / 255.0, 0.02) * np.maximum(cosine, 0.05)
    sigma = noise * (TOF_FLOOR_M + TOF_PER_M2 * depth_m**2 / np.sqrt(amplitude / 0.3))
    seen = _with_flying_pixels(depth_m.astype(np.float32), rng)
    read = seen + WIGGLE_M * np.sin(2.0 * np.pi * seen / WIGGLE_PERIOD_M) + sigma * rng.standard_normal(depth_m.shape, dtype=np.float32)
    lost = (amplitude < DARK * (depth_m / 3.0) ** 2) | (depth_m < TOF_RANGE_M[0]) | (depth_m > TOF_RANGE_M[1]) | (read <= 0.0)
    return np.where(lost, np.float32(0.0), np.round(read, 3)).astype(np.float32)


def coarse(depth_m: F32, factor: int) -> F32:
    """Depth of a camera with fewer pixels, each reading repeated over `factor` × `factor` pixels of colour."""
    small = depth_m[factor // 2 :: factor, factor // 2 :: factor]
    h, w = depth_m.shape
    return np.ascontiguousarray(np.repeat(np.repeat(small, factor, axis=0), factor, axis=1)[:h, :w])


def _with_flying_pixels(depth_m: F32, rng: np.random.Generator) -> F32:
    """At edges a part of the pixels report a mean of the nearest and the farthest surface in their neighbourhood."""
    near, far = cv2.erode(depth_m, np.ones((3, 3), np.uint8)), cv2.dilate(depth_m, np.ones((3, 3), np.uint8))
    flying = (far - near > FLYING_JUMP * near) & (rng.random(depth_m.shape, dtype=np.float32) < FLYING_SHARE)
    share = rng.random(depth_m.shape, dtype=np.float32)
    return np.where(flying, near + share * (far - near), depth_m).astype(np.float32)


def stereo_depth(depth_m: F64, gray: U8, fx: float, noise: float, rng: np.random.Generator) -> F32:
    """Active stereo: disparity noise alike over the matched window (so range-squared in depth), near surfaces fattened, holes where there is neither
    texture nor enough of the projector's pattern, and the side that only one camera sees."""
    h, w = depth_m.shape
    size = w / 640.0
    width = 2 * round(FATTENED_PX * size / 2.0) + 1
    fat = cv2.erode(depth_m.astype(np.float32), np.ones((width, width), np.uint8))
    focal_m = fx * STEREO_BASELINE_M
    white = cv2.GaussianBlur(rng.standard_normal((h, w), dtype=np.float32), (0, 0), max(STEREO_WINDOW_PX * size, 0.5))
    disparity = focal_m / fat + noise * SUBPIXEL_PX * white / max(float(white.std()), 1e-6)
    disparity = np.round(disparity * STEREO_STEPS) / STEREO_STEPS
    read = focal_m / np.maximum(disparity, 1e-3)
    lost = _low_contrast_mask(gray, fat, rng, size) | _hidden_from_left(fat, focal_m) | (fat < STEREO_RANGE_M[0]) | (fat > STEREO_RANGE_M[1])
    return np.where(lost, np.float32(0.0), read).astype(np.float32)


def _low_contrast_mask(gray: U8, depth_m: F32, rng: np.random.Generator, size: float) -> Bool:
    """(h, w) whether the contrast in the window is too low to be matched; the limit varies in blobs."""
    window = (2 * round(TEXTURE_WINDOW_PX * size / 2.0) + 1,) * 2
    seen = gray.astype(np.float32) + GRAY_NOISE * rng.standard_normal(gray.shape, dtype=np.float32)
    mean = cv2.blur(seen, window)
    variance = np.maximum(cv2.blur(seen * seen, window) - mean * mean - GRAY_NOISE**2, 0.0)
    contrast = np.sqrt(variance + (PROJECTED / depth_m**2) ** 2)
    blobs = cv2.GaussianBlur(rng.standard_normal(gray.shape, dtype=np.float32), (0, 0), max(6.0 * size, 1.0))
    return np.asarray(contrast < LEAST_TEXTURE * (1.0 + 0.4 * blobs / max(float(blobs.std()), 1e-6)))


def _hidden_from_left(depth_m: F32, focal_m: float) -> Bool:
    """(h, w) whether something further right, that is nearer, hides a pixel from the second camera."""
    column = np.arange(depth_m.shape[1]) - focal_m / depth_m
    nearest = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(column > nearest + 1.0)


def lidar_depth(depth_m: F64, time_s: float, noise: float, rng: np.random.Generator) -> F32:
    """A telephone's lidar, few points made dense by a network: 256 readings a line, smooth over edges, errors alike over several of them, and a scale
    that wanders."""
    h, w = depth_m.shape
    width = min(LIDAR_WIDTH, w)
    small = cv2.resize(depth_m.astype(np.float32), (width, round(h * width / w)), interpolation=cv2.INTER_AREA)
    white = cv2.GaussianBlur(rng.standard_normal(small.shape, dtype=np.float32), (0, 0), LIDAR_CORRELATION_PX)
    small = small + noise * (LIDAR_FLOOR_M + LIDAR_SHARE * small) * white / max(float(white.std()), 1e-6)
    read = cv2.resize(small, (w, h), interpolation=cv2.INTER_LINEAR) * (1.0 + LIDAR_SCALE * np.sin(2.0 * np.pi * time_s / LIDAR_PERIOD_S))
    lost = (depth_m < LIDAR_RANGE_M[0]) | (depth_m > LIDAR_RANGE_M[1])
    return np.where(lost, np.float32(0.0), read).astype(np.float32)
