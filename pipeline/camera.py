"""The pinhole camera and its depth noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.arrays import F64


@dataclass(frozen=True)
class DepthNoise:
    """Standard deviation of a depth reading: `max(floor_m, a + b z + c z²)` metres at z metres. Belongs to the sensor, so to the data set."""

    a_m: float = -0.00058
    b: float = 0.00074
    c_per_m: float = 0.00273
    floor_m: float = 0.001

    def sigma_m(self, depth_m: Any) -> Any:
        """Standard deviation in metres for depth(s) in metres; same shape."""
        return np.maximum(self.floor_m, self.a_m + self.b * depth_m + self.c_per_m * depth_m * depth_m)


EXACT_DEPTH = DepthNoise(a_m=0.0, b=0.0, c_per_m=0.0, floor_m=0.001)


@dataclass(frozen=True)
class Camera:
    """An undistorted pinhole camera; readers undistort before they hand a frame over. `fps` is nominal."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    fps: float = 30.0
    depth_noise: DepthNoise = field(default_factory=DepthNoise)

    @property
    def K(self) -> F64:
        """(3, 3) calibration matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> F64:
        """(4,) fx, fy, cx, cy in pixels, as compiled loops and the map take them."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    def project(self, points_m: F64) -> F64:
        """(n, 3) points in the camera frame -> (n, 2) pixels; points behind the camera give NaN."""
        z = np.where(points_m[..., 2] > 1e-6, points_m[..., 2], np.nan)
        return np.stack([self.fx * points_m[..., 0] / z + self.cx, self.fy * points_m[..., 1] / z + self.cy], axis=-1)

    def back_project(self, pixels: NDArray[Any], depth_m: NDArray[Any]) -> NDArray[Any]:
        """(n, 2) pixels with (n,) depths -> (n, 3) points in the camera frame."""
        x = (pixels[..., 0] - self.cx) / self.fx * depth_m
        y = (pixels[..., 1] - self.cy) / self.fy * depth_m
        return np.stack([x, y, depth_m], axis=-1)
