"""Normals from the spherical range image, OpenCV's."""

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


@register("normals", "sri")
@dataclass(frozen=True)
class Sri(CloudOptions):
    """Derivatives of the spherical range image (Badino et al., ICRA 2011; OpenCV's RgbdNormals).

    The image is resampled to equal angles and the normals back, so a strip along the image's border, where that reaches outside, has none."""

    window: Annotated[int, OneOf(3, 5, 7)] = 5  # cells of the derivative, 3, 5 or 7

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells; NaN near missing depth, a depth edge or the image's border."""
        half = self.window // 2
        return cloud_normals(self, self._method, frame, cv2.RgbdNormals_RGBD_NORMALS_METHOD_SRI, self.window, reach=half + 2, border=half + 4)

    @cached_property
    def _method(self) -> PerThread[CloudMethod]:
        return PerThread(CloudMethod)
