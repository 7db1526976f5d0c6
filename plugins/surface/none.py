"""No surface."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Pose, Surface


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
        """No vertex, triangle or plane."""
        index, stamp_ns = (state.index, state.stamp_ns) if state is not None else (0, 0)
        return Surface.empty(index, stamp_ns)
