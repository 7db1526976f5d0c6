"""Normals by fast approximate least squares, OpenCV's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2

from trihedron.pipeline.core.options import OneOf
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.normals.common import CloudNormals


@register("normals", "fals")
@dataclass(frozen=True)
class Fals(CloudNormals):
    """Fast approximate least squares (Badino et al., ICRA 2011; OpenCV's RgbdNormals): the plane of each window, from rays known beforehand."""

    window: Annotated[int, OneOf(3, 5, 7)] = 5  # cells, 3, 5 or 7

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells; NaN within half a window of missing depth or a depth edge."""
        return self._normals(frame, cv2.RgbdNormals_RGBD_NORMALS_METHOD_FALS, self.window, reach=self.window // 2, border=0)
