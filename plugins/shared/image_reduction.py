"""Image pyramids of intensity and depth for dense alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, U8, Frame
from trihedron.plugins.shared.image_reduction_kernels import average_blocks, halve_images

LUMINANCE = (0.299, 0.587, 0.114)  # of red, green and blue (Rec. 601)


@dataclass(frozen=True)
class Level:
    """An image of a pyramid: brightness (h, w) 0 … 255, NaN = none, depth (h, w), m, 0 = none, and (fx, fy, cx, cy)."""

    gray: F32
    depth_m: F32
    intrinsics: F64


def step_to(frame: Frame, width: int) -> int:
    """Return the reduction of a frame to an image about `width` wide, in pixels."""
    return max(1, round(frame.camera.width / width))


def reduced_intrinsics(frame: Frame, step: int) -> F64:
    """Return (fx, fy, cx, cy) of the frame reduced by `step`."""
    c, offset = frame.camera, (step - 1) / 2.0
    return np.array([c.fx / step, c.fy / step, (c.cx - offset) / step, (c.cy - offset) / step])


def pyramid(frame: Frame, width: int, levels: int) -> list[Level]:
    """Build the pyramid of a frame from about `width` columns, the finest level first."""
    step = step_to(frame, width)
    depth, color = average_blocks(frame.depth_m, frame.color, step)
    return halvings(Level(brightness(color), depth, reduced_intrinsics(frame, step)), levels)


def halvings(finest: Level, levels: int) -> list[Level]:
    """Halve an image again and again, the finest level first."""
    out = [finest]
    for _ in range(levels - 1):
        fx, fy, cx, cy = out[-1].intrinsics
        gray, depth = halve_images(out[-1].gray, out[-1].depth_m)
        out.append(Level(gray, depth, np.array([fx / 2.0, fy / 2.0, (cx - 0.5) / 2.0, (cy - 0.5) / 2.0])))
    return out


def brightness(color: U8) -> F32:
    """Convert RGB (h, w, 3) to luminance (h, w), 0 … 255."""
    return np.asarray(matmul(color, np.array(LUMINANCE, np.float32)), np.float32)
