"""No loop closing."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Correction, Map


@register("loop", "none")
@dataclass(frozen=True)
class NoLoop:
    """Skip loop closing."""

    def __call__(self, map: Map) -> Correction | None:
        """Return None."""
        return None
