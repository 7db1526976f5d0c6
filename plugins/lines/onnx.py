"""Learned line segments by a network in an ONNX file."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, F64, Frame, LineSegments
from trihedron.plugins.lines.segment_completion import MIN_SIDE_PX, LineOptions, line_segments, reduce_image
from trihedron.plugins.shared.networks import NetworkImage, NetworkOptions, network_image
from trihedron.plugins.shared.per_thread import PerThread


class LineOutput(Enum):
    """Output of a network of lines."""

    segments = "lines"  # (1, n, 4) x, y, x, y in pixels, and `scores` (1, n)
    distance_field = "df"  # (1, h, w) distance to the nearest line in pixels (DeepLSD)


@register("lines", "onnx")
@dataclass(frozen=True)
class OnnxLines(NetworkOptions, LineOptions):
    """Line segments of a network that the user gives: `image` (1, c, h, w) in 0 … 1 to `lines` and `scores` (M-LSD: Gu et al., AAAI 2022), or to the
    distance field `df` of DeepLSD (Pautrat et al., CVPR 2023), whose valleys are thinned and cut into straight runs by OpenCV's fast line detector
    (DeepLSD's own tracing is not in its network).

    Fragments are merged, placed and described like those of `lsd`. Library: ONNX Runtime (MIT), one thread. The bytes may differ on another CPU."""

    slot: ClassVar[str] = "lines"
    scale: Annotated[float, Range(0.1, 1)] = 1.0  # of the image the segments are described on
    output: LineOutput = LineOutput.segments
    channels: Annotated[int, Range(1, 3)] = 1  # 1: grey; 3: RGB
    multiple: PositiveInt = 32  # of which the image's sides are one
    min_score: Share = 0.1
    valley_px: PositiveFloat = 1.0  # distance within which a pixel is on a line

    def __call__(self, frame: Frame) -> LineSegments:
        """The longest segments, longest first; (n, 32) binary descriptors."""
        network = self.network
        small = reduce_image(self, frame.gray)
        if min(frame.gray.shape) < MIN_SIDE_PX:
            return line_segments(self, frame, small, None)
        image = network_image(frame, network, "image", 3 if self.channels > 1 else 1, self.multiple)
        if self.output is LineOutput.distance_field:
            field = network.rows("df", network.run({"image": image.tensor}, ("df",))[0], *image.tensor.shape[2:])
            ends = self._trace(field)
        else:
            outputs = network.run({"image": image.tensor}, ("lines", "scores"))
            ends = network.rows("lines", outputs[0], None, 4)
            ends = ends[network.rows("scores", outputs[1], len(ends)) >= self.min_score]
        return line_segments(self, frame, small, self._clip(ends, image, frame) * self.scale)

    def _clip(self, ends: F32, image: NetworkImage, frame: Frame) -> F64:
        """Segments (n, 4) in the frame's pixels, those that lie outside left out."""
        pixels = image.pixels(ends.reshape(-1, 2, 2))
        height, width = frame.gray.shape
        inside = ((pixels > -1.0) & (pixels < [width, height])).all(axis=(1, 2))
        return np.clip(pixels[inside], 0.0, [width - 1.0, height - 1.0]).reshape(-1, 4)

    def _trace(self, field: F32) -> F32:
        """Straight runs (n, 4) of the pixels within `valley_px` of a line, thinned."""
        valley = np.where(field <= self.valley_px, 255, 0).astype(np.uint8)
        if not valley.any():
            return np.zeros((0, 4), np.float32)
        found = self._detector().detect(cv2.ximgproc.thinning(valley))
        return np.zeros((0, 4), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 4)

    @cached_property
    def _detector(self) -> PerThread[Any]:
        """The detector of each thread; it takes an image of edges as it is."""
        return PerThread(partial(cv2.ximgproc.createFastLineDetector, max(int(0.5 * self.min_length_px), 3), 1.41, 20.0, 50.0, 0, False))
