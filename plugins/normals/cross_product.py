"""Normals by the cross product of neighbouring points, OpenCV's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.normals.opencv_normals import CloudMethod, CloudOptions, cloud_normals
from trihedron.plugins.shared.per_thread import PerThread


@register("normals", "cross_product")
@dataclass(frozen=True)
class CrossProduct(CloudOptions):
    """Cross product of the steps to neighbouring points (OpenCV's RgbdNormals): cheapest, and exact on exact planes; all its resistance to noise is
    that of the averaged points."""

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells; NaN beside missing depth, a depth edge or the image's border."""
        return cloud_normals(self, self._method, frame, cv2.RgbdNormals_RGBD_NORMALS_METHOD_CROSS_PRODUCT, 1, reach=1, border=1)

    @cached_property
    def _method(self) -> PerThread[CloudMethod]:
        return PerThread(CloudMethod)
