"""Normals from the spherical range image, OpenCV's."""

from __future__ import annotations

from dataclasses import dataclass

import cv2

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.normals.common import CloudNormals


@register("normals", "sri")
@dataclass(frozen=True)
class Sri(CloudNormals):
    """Derivatives of the spherical range image (Badino et al., ICRA 2011; OpenCV's RgbdNormals).

    The image is resampled to equal angles and the normals back, so a strip along the image's border, where that reaches outside, has none."""

    window: int = 5  # cells of the derivative, 3, 5 or 7

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window not in (3, 5, 7):
            raise ValueError("window: must be 3, 5 or 7 cells")

    def __call__(self, frame: Frame) -> Normals:
        """Normals on a grid of ceil(h / stride) × ceil(w / stride) cells; NaN near missing depth, a depth edge or the image's border."""
        half = self.window // 2
        return self._normals(frame, cv2.RgbdNormals_RGBD_NORMALS_METHOD_SRI, self.window, reach=half + 2, border=half + 4)
