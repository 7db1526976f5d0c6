"""Faults of images: each function takes colour (h, w, 3) RGB and depth (h, w) in metres, 0 = none, and returns them spoilt."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import F32, U8, Camera

SKIN = (150, 105, 85)  # RGB of a hand before the camera, out of focus
HOLE_PX = 12.0  # size of the blobs in which depth is missing, at 640 pixels a line
PATCHES = 6  # of glass and mirror, by turns
OBJECTS = 8  # that move before the camera
OBJECT_DEPTH_M, OBJECT_RADIUS_M, SWAY_M = (0.9, 1.6), 0.2, 0.25
SUB_FRAMES = 8  # of an exposure


def hand(shape: tuple[int, ...], rng: np.random.Generator) -> U8:
    """(h, w, 3) what a camera sees that is covered by a hand: its skin, out of focus."""
    rough = np.asarray(SKIN) + rng.normal(0.0, 12.0, (4, 5, 1))
    return np.asarray(np.clip(cv2.resize(rough.astype(np.float32), shape[1::-1], interpolation=cv2.INTER_CUBIC), 0, 255), np.uint8)


def with_gamma(color: U8, gamma: float) -> U8:
    """Grey levels to the power `gamma`: above 1 the image is darker."""
    return np.asarray(cv2.LUT(color, np.rint(255.0 * (np.arange(256) / 255.0) ** gamma).astype(np.uint8)), np.uint8)


def with_color_noise(color: U8, sigma: float, rng: np.random.Generator) -> U8:
    """White noise of so many grey levels (standard deviation)."""
    noise = np.float32(sigma) * rng.standard_normal(color.shape, dtype=np.float32)
    return np.clip(np.rint(color + noise), 0.0, 255.0).astype(np.uint8)


def partly(image: NDArray[Any], other: NDArray[Any], share: float) -> NDArray[Any]:
    """The first image in `share` of the columns, from the left, and the other one in the rest."""
    columns = round(share * image.shape[1])
    return np.concatenate([image[:, :columns], other[:, columns:]], axis=1)


def noisy(depth_m: F32, times: float, camera: Camera, rng: np.random.Generator) -> F32:
    """White noise of `times` the standard deviation that the camera states of its depth."""
    noise = np.float32(times) * camera.depth_noise.sigma_m(depth_m).astype(np.float32) * rng.standard_normal(depth_m.shape, dtype=np.float32)
    return np.where(depth_m > 0.0, np.maximum(depth_m + noise, np.float32(1e-3)), np.float32(0.0))


def with_holes(depth_m: F32, share: float, rng: np.random.Generator) -> F32:
    """Depth missing in blobs that make `share` of the image."""
    h, w = depth_m.shape
    size = HOLE_PX * w / 640.0
    rough = rng.standard_normal((max(2, round(h / size)), max(2, round(w / size))), dtype=np.float32)
    field = np.asarray(cv2.resize(rough, (w, h), interpolation=cv2.INTER_CUBIC))
    return np.where(field < np.quantile(field, share), np.float32(0.0), depth_m)


def not_finite(depth_m: F32, share: float, rng: np.random.Generator) -> F32:
    """`share` of the readings NaN, infinite, or infinite and negative."""
    chosen = rng.random(depth_m.shape, dtype=np.float32) < share
    values = np.array([np.nan, np.inf, -np.inf], np.float32)[rng.integers(0, 3, depth_m.shape)]
    return np.where(chosen, values, depth_m)


def resize_frame(color: U8, depth_m: F32, camera: Camera, times: float) -> tuple[U8, F32, Camera]:
    """Another resolution, with its camera: colour by area, depth by nearest neighbour."""
    width, height = round(camera.width * times), round(camera.height * times)
    sx, sy = width / camera.width, height / camera.height
    centre = (camera.cx + 0.5) * sx - 0.5, (camera.cy + 0.5) * sy - 0.5
    stated = Camera(width, height, camera.fx * sx, camera.fy * sy, *centre, camera.fps, camera.depth_noise, camera.sigmas)
    small = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA if times < 1.0 else cv2.INTER_LINEAR)
    return np.asarray(small, np.uint8), np.asarray(cv2.resize(depth_m, (width, height), interpolation=cv2.INTER_NEAREST), np.float32), stated


def with_moving_objects(color: U8, depth_m: F32, share: float, time_s: float, rng: np.random.Generator) -> tuple[U8, F32]:
    """Upright textured columns, as people are, that pass by before the camera, each at its own speed, to and fro; together they would cover `share`
    of the image if none hid another. `rng` must be the same for all frames of a sequence."""
    h, w = depth_m.shape
    color, depth_m = color.copy(), depth_m.copy()
    for _ in range(OBJECTS):
        high, speed, phase, z = rng.uniform(0.35, 0.6), rng.choice([-1, 1]) * rng.uniform(0.15, 0.4), rng.uniform(), rng.uniform(*OBJECT_DEPTH_M)
        clothes = rng.uniform(60.0, 180.0, 3) + rng.uniform(-50.0, 50.0, (12, 6, 1))
        rows = round(high * h)
        columns = round(1.4 * share * w * h / (OBJECTS * rows))  # 1.4: on the way round it is out of the image for a part
        top = round(rng.uniform(0.0, h - rows))
        left = round((w + columns) * ((phase + speed * time_s) % 1.0)) - columns
        first, stop = max(left, 0), min(left + columns, w)
        across = (np.arange(first, stop) - left + 0.5) / columns
        round_m = OBJECT_RADIUS_M * (1.0 - np.sqrt(1.0 - (2.0 * across - 1.0) ** 2))
        if first < stop:
            seen = np.asarray(cv2.resize(clothes, (columns, rows), interpolation=cv2.INTER_CUBIC)).clip(0.0, 255.0).astype(np.uint8)
            color[top : top + rows, first:stop] = seen[:, first - left : stop - left]
            depth_m[top : top + rows, first:stop] = z + SWAY_M * np.sin(2.0 * np.pi * (time_s * abs(speed) * 2.0 + phase)) + round_m
    return color, depth_m


def with_reflections(color: U8, depth_m: F32, share: float, rng: np.random.Generator) -> tuple[U8, F32]:
    """Patches of the image, `share` of it in all: in every other one a mirror shows the image turned round, as far away as that is; between them
    glass, behind which depth is missing but for a few readings. `rng` must be the same for all frames of a sequence."""
    h, w = depth_m.shape
    turned, far = color[:, ::-1], depth_m[:, ::-1]
    color, depth_m = color.copy(), depth_m.copy()
    speckle = rng.random((h, w), dtype=np.float32) < 0.1
    for number in range(PATCHES):
        rows = round(rng.uniform(0.3, 0.5) * h)
        columns = min(round(share * w * h / (PATCHES * rows)), w)
        top, left = round(rng.uniform(0.0, h - rows)), round((w - columns) * (number + rng.uniform(0.0, 0.9)) / PATCHES)
        patch = slice(top, top + rows), slice(left, left + columns)
        if number % 2:
            depth_m[patch] = np.where(speckle[patch], depth_m[patch], np.float32(0.0))
        else:
            color[patch], depth_m[patch] = turned[patch], far[patch] + depth_m[patch]
    return color, depth_m


def flow_px(gray: U8, other: U8) -> F32:
    """(h, w, 2) where each pixel of an image lies in another one, less where it lies."""
    return np.asarray(cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(gray, other, None), np.float32)


def add_motion_blur(color: U8, flow: F32, exposure: float) -> U8:
    """The mean over an exposure that lasts `exposure` of the time in which the image moves by `flow`."""
    total = np.zeros(color.shape, np.float32)
    for when in exposure * ((np.arange(SUB_FRAMES) + 0.5) / SUB_FRAMES - 0.5):
        total += _warp_by_flow(color, flow, np.float32(when), cv2.INTER_LINEAR)
    return np.rint(total / SUB_FRAMES).astype(np.uint8)


def add_rolling_shutter(color: U8, depth_m: F32, flow: F32, readout: float) -> tuple[U8, F32]:
    """Rows read one after the other; the whole image takes `readout` of the time in which it moves by `flow`, its middle row is on time."""
    h = len(depth_m)
    when = (readout * ((np.arange(h) + 0.5) / h - 0.5)).astype(np.float32)[:, None]
    return _warp_by_flow(color, flow, when, cv2.INTER_LINEAR), _warp_by_flow(depth_m, flow, when, cv2.INTER_NEAREST)


def _warp_by_flow(image: NDArray[Any], flow: F32, when: Any, how: int) -> NDArray[Any]:
    """The image a part `when` of the flow later."""
    h, w = image.shape[:2]
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    x, y = x - when * flow[..., 0], y - when * flow[..., 1]
    return np.asarray(cv2.remap(image, x, y, how, borderMode=cv2.BORDER_REPLICATE))
