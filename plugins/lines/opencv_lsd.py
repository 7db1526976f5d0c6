"""LSD line segments by OpenCV, with OpenCV's LBD descriptors where the build has them."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import cv2
import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, PositiveShare, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, U8, Frame, LineSegments

MIN_SIDE_PX = 16  # px, side of an image that the detector is given
LBD_BYTES = 32


@register("lines", "opencv_lsd")
@dataclass(frozen=True)
class OpenCvLsd:
    """`cv2.createLineSegmentDetector` (von Gioi, Jakubowicz, Morel, Randall, PAMI 2010) with OpenCV's defaults, the longest segments of the full
    image; neither merged nor placed again.

    Described by LBD (Zhang and Koch, 2013), `cv2.line_descriptor.BinaryDescriptor`; without descriptors in a build of OpenCV that lacks it. Library:
    OpenCV (Apache-2.0). The bytes may differ on another CPU."""

    scale: Annotated[float, Range(0.1, 1)] = 0.8  # of the image the detector looks at
    sigma_scale: PositiveFloat = 0.6  # sigma of its blur over the scale
    quantisation: PositiveFloat = 2.0  # grey levels a gradient may be wrong by
    tolerance_deg: Annotated[float, Range(5, 45)] = 22.5  # of a gradient's direction
    density: PositiveShare = 0.7  # of a segment's rectangle
    segments: PositiveInt = 150  # most segments retained, the longest
    min_length_px: Annotated[float, Range(4)] = 20.0  # shortest segment retained
    band_px: Annotated[int, Range(1, 31)] = 7  # widthOfBand of LBD

    def __call__(self, frame: Frame) -> LineSegments:
        """The longest segments, longest first; (n, 32) binary descriptors."""
        found = self._detector.detect(frame.gray)[0] if min(frame.gray.shape) >= MIN_SIDE_PX else None
        endpoints = np.zeros((0, 2, 2), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 2, 2)
        length = np.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=1)
        order = np.argsort(-length, kind="stable")
        endpoints = np.ascontiguousarray(endpoints[order[length[order] >= self.min_length_px][: self.segments]])
        return LineSegments(index=frame.index, stamp_ns=frame.stamp_ns, endpoints_px=endpoints, descriptors=self._describe(frame.gray, endpoints))

    def _describe(self, gray: U8, endpoints: F32) -> U8:
        """(n, 32) LBD of segments (n, 2, 2); (n, 0) where the build has none."""
        if not hasattr(cv2, "line_descriptor"):
            return np.zeros((len(endpoints), 0), np.uint8)
        if not len(endpoints):
            return np.zeros((0, LBD_BYTES), np.uint8)
        return np.asarray(self._descriptor.compute(gray, key_lines(endpoints, gray.shape))[1], np.uint8)

    @property
    def _detector(self) -> Any:
        """This thread's detector: it holds the image it looks at."""
        if not hasattr(self._local, "lsd"):
            options = {"scale": self.scale, "sigma_scale": self.sigma_scale, "quant": self.quantisation}
            self._local.lsd = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, **options, ang_th=self.tolerance_deg, density_th=self.density)
        return self._local.lsd

    @property
    def _descriptor(self) -> Any:
        """This thread's descriptor: it holds the gradients of its image."""
        if not hasattr(self._local, "lbd"):
            self._local.lbd = cv2.line_descriptor.BinaryDescriptor.createBinaryDescriptor()
            self._local.lbd.setWidthOfBand(self.band_px)
        return self._local.lbd

    @cached_property
    def _local(self) -> threading.local:
        """Holds each thread's detector."""
        return threading.local()


def key_lines(endpoints: F32, shape: tuple[int, ...]) -> list[Any]:
    """Convert segments (n, 2, 2) to OpenCV's key lines, their ends moved into the image (h, w)."""
    out = []
    for k, ends in enumerate(np.clip(endpoints, 0.0, [shape[1] - 1.0, shape[0] - 1.0]).tolist()):
        (a, b), (c, d) = ends
        line = cv2.line_descriptor.KeyLine()
        line.startPointX, line.startPointY, line.endPointX, line.endPointY = a, b, c, d
        line.sPointInOctaveX, line.sPointInOctaveY, line.ePointInOctaveX, line.ePointInOctaveY = a, b, c, d
        line.pt, line.angle, line.lineLength = ((a + c) / 2.0, (b + d) / 2.0), math.atan2(d - b, c - a), math.hypot(c - a, d - b)
        line.class_id, line.octave, line.size, line.response = k, 0, (c - a) * (d - b), line.lineLength / max(shape)
        line.numOfPixels = int(max(abs(c - a), abs(d - b))) + 1
        out.append(line)
    return out
