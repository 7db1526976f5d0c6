"""Normals by the cross product of neighbouring points, OpenCV's."""

from __future__ import annotations

from dataclasses import dataclass

import cv2

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.normals.common import CloudNormals


@register("normals", "cross_product")
@dataclass(frozen=True)
class CrossProduct(CloudNormals):
    """Cross product of the steps to neighbouring points (OpenCV's RgbdNormals): cheapest, and exact on exact planes; all its resistance to noise is
    that of the averaged points."""

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells; NaN beside missing depth, a depth edge or the image's border."""
        return self._normals(frame, cv2.RgbdNormals_RGBD_NORMALS_METHOD_CROSS_PRODUCT, 1, reach=1, border=1)
