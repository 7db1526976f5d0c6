"""No relocalisation."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Pose


@register("relocalise", "none")
@dataclass(frozen=True)
class NoRelocalisation:
    """A camera that is lost finds back only near its last pose."""

    def __call__(self, map: Map | None) -> Pose | None:
        """None, whatever is given."""
        return None
