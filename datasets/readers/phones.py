"""Recordings of a phone with LiDAR: colour reduced to the depth image, whose pixels it shares, and the confidence of depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import cv2
import numpy as np

from trihedron.datasets.readers.images import MAX_PIXELS
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.options import Range
from trihedron.pipeline.core.types import F32, U8, Camera

Confidence: TypeAlias = Annotated[int, Range(0, 2)]
MAX_SIDE = 1 << 15


@dataclass(frozen=True)
class ColorIntrinsics:
    """Intrinsics of the whole colour image in pixels, and its size; the depth image shows the same, smaller."""

    width: float
    height: float
    fx: float
    fy: float
    cx: float
    cy: float

    def reduced(self, width: int, height: int, fps: float, place: str) -> Camera:
        """Return the camera of the depth image. Raises DataError, naming the place, for what describes none."""
        numbers = (self.width, self.height, self.fx, self.fy, fps)
        if not (all(math.isfinite(x) and x > 0 for x in numbers) and math.isfinite(self.cx) and math.isfinite(self.cy)):
            raise DataError(place, "does not describe a camera", "width, height, focal lengths and rate must be positive")
        if not (0 < width < MAX_SIDE and 0 < height < MAX_SIDE and width * height <= MAX_PIXELS):
            raise DataError(place, f"claims depth of {width}×{height} pixels", "record it again")
        x, y = width / self.width, height / self.height
        return Camera(width, height, self.fx * x, self.fy * y, (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5, fps)


def reduce(image: U8, camera: Camera) -> U8:
    """Reduce the colour image to the size of depth, (h, w, 3): each pixel is the mean of the area it covers."""
    return np.asarray(cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)


def trusted(depth_m: F32, confidence: U8, least: int, path: Path) -> F32:
    """Depth (h, w), 0 where its confidence (h, w), 0 … 2, is below `least`. Raises DataError for confidences of another size."""
    if confidence.shape != depth_m.shape:
        cause = f"is {confidence.shape[1]}×{confidence.shape[0]} while its depth is {depth_m.shape[1]}×{depth_m.shape[0]}"
        raise DataError(str(path), cause, "give dataset.confidence=0 to do without")
    return np.where(confidence >= least, depth_m, np.float32(0.0))
