"""No key points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Keypoints


@register("keypoints", "none")
@dataclass(frozen=True)
class NoKeypoints:
    """A value without rows: what the rest of the system does without points."""

    descriptor_bytes: Annotated[int, Range(1, 4096)] = 32  # length of the (absent) descriptors, that of ORB

    def __call__(self, frame: Frame) -> Keypoints:
        """Zero key points."""
        return Keypoints(
            index=frame.index,
            stamp_ns=frame.stamp_ns,
            pixels=np.zeros((0, 2), np.float32),
            points_m=np.zeros((0, 3), np.float32),
            sigma_px=np.zeros(0, np.float32),
            sigma_m=np.zeros(0, np.float32),
            octaves=np.zeros(0, np.uint8),
            angles_deg=np.zeros(0, np.float32),
            descriptors=np.zeros((0, self.descriptor_bytes), np.uint8),
        )
