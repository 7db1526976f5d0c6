"""No relocalisation."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Pose


@register("relocalise", "none")
@dataclass(frozen=True)
class NoRelocalisation:
    """Skip relocalisation: a lost camera is tracked again only near its last pose."""

    def __call__(self, map: Map | None) -> Pose | None:
        """Return None."""
        return None
