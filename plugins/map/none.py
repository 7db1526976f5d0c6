"""No map."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Pose


@register("map", "none")
@dataclass(frozen=True)
class NoMap:
    """Skip mapping: every pose is relative to the previous frame alone."""

    def __call__(self, pose: Pose) -> Map | None:
        """Return None."""
        return None

    def localising(self) -> NoMap:
        """Return itself."""
        return self
