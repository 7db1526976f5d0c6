"""Normals by fast approximate least squares, OpenCV's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import cv2

from trihedron.pipeline.core.options import OneOf
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.normals.opencv_normals import CloudMethod, CloudOptions, cloud_normals
from trihedron.plugins.shared.per_thread import PerThread


@register("normals", "fals")
@dataclass(frozen=True)
class Fals(CloudOptions):
    """Fast approximate least squares (Badino et al., ICRA 2011; OpenCV's RgbdNormals): the plane of each window, from rays known beforehand."""

    window: Annotated[int, OneOf(3, 5, 7)] = 5  # cells, 3, 5 or 7

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells; NaN within half a window of missing depth or a depth edge."""
        return cloud_normals(self, self._method, frame, cv2.RgbdNormals_RGBD_NORMALS_METHOD_FALS, self.window, reach=self.window // 2, border=0)

    @cached_property
    def _method(self) -> PerThread[CloudMethod]:
        return PerThread(CloudMethod)
