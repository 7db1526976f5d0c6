"""Colour as a camera exposes it: motion blur by the true motion of each pixel, automatic exposure, vignetting, noise by gain, JPEG."""

from __future__ import annotations

import cv2
import numpy as np

from trihedron.datasets.simulation.depth_noise import IMAGE_SIGMA
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, U8, Camera

SUB_FRAMES = 7  # of an exposure
MID_GRAY, GAINS = 110.0, (0.5, 2.0)  # mean brightness that the automatic exposure aims at, and its limits
VIGNETTE = 0.25  # of the light is missing in the corners


def motion_px(depth_m: F64, camera: Camera, T_world_before: F64, T_world_after: F64) -> F32:
    """(h, w, 2) pixels by which what is seen moves from one pose to the other."""
    x, y = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    T, z = matmul(invert(T_world_after), T_world_before).astype(np.float32), depth_m.astype(np.float32)
    X, Y = (x - np.float32(camera.cx)) / np.float32(camera.fx) * z, (y - np.float32(camera.cy)) / np.float32(camera.fy) * z
    moved = [T[k, 0] * X + T[k, 1] * Y + T[k, 2] * z + T[k, 3] for k in range(3)]
    ahead = np.maximum(moved[2], np.float32(1e-3))
    u, v = np.float32(camera.fx) * moved[0] / ahead + np.float32(camera.cx), np.float32(camera.fy) * moved[1] / ahead + np.float32(camera.cy)
    return np.stack([u - x, v - y], axis=-1)


def motion_blurred(color: U8, flow: F32) -> U8:
    """Mean over an exposure in which the image moves by `flow`, centred on the image."""
    h, w = color.shape[:2]
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    total = np.zeros(color.shape, np.float32)
    for when in (np.arange(SUB_FRAMES, dtype=np.float32) + 0.5) / SUB_FRAMES - 0.5:
        total += cv2.remap(color, x - when * flow[..., 0], y - when * flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.rint(total / SUB_FRAMES), np.uint8)


def gain_for(mean_gray: float, strength: float) -> float:
    """Gain of an automatic exposure that saw an image of this mean; `strength` 1 brings it to MID_GRAY, 0 leaves it."""
    return float(np.clip((MID_GRAY / max(mean_gray, 1.0)) ** strength, *GAINS))


def expose_image(color: U8, gain: float, jpeg_quality: int, rng: np.random.Generator) -> U8:
    """Brightness times gain, darker corners, noise that grows with the gain, clipped; compressed unless `jpeg_quality` is 0."""
    h, w = color.shape[:2]
    y, x = np.mgrid[:h, :w].astype(np.float32)
    radius2 = ((x - (w - 1) / 2.0) ** 2 + (y - (h - 1) / 2.0) ** 2) / ((w**2 + h**2) / 4.0)
    light = np.float32(gain) * (1.0 - VIGNETTE * radius2)[..., None]
    noise = np.float32(IMAGE_SIGMA * gain) * rng.standard_normal((h, w, 1), dtype=np.float32)
    seen = np.asarray(np.clip(np.rint(color * light + noise), 0, 255), np.uint8)
    if not jpeg_quality:
        return seen
    _, data = cv2.imencode(".jpg", seen[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1], np.uint8)
