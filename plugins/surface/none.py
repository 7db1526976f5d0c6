"""No surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.registry import register
from trihedron.pipeline.types import Map, Pose, Surface


@register("surface", "none")
@dataclass(frozen=True)
class NoSurface:
    """A mesh without triangles; the state is the last pose, whose index and stamp the mesh bears."""

    def start(self) -> Pose | None:
        """Nothing seen yet."""
        return None

    def add(self, state: Pose | None, pose: Pose) -> Pose | None:
        """Remember the frame."""
        return pose

    def finish(self, state: Pose | None, map: Map | None) -> Surface:
        """(0, 3) vertices and triangles."""
        index, stamp_ns = (state.index, state.stamp_ns) if state is not None else (0, 0)
        triangles = np.empty((0, 3), np.int32)
        return Surface(index, stamp_ns, np.empty((0, 3)), np.empty((0, 3), np.uint8), triangles, np.empty(0, np.int32))
