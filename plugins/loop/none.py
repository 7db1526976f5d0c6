"""No loop closing."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Correction, Map


@register("loop", "none")
@dataclass(frozen=True)
class NoLoop:
    """Places seen before are not recognised."""

    def __call__(self, map: Map) -> Correction | None:
        """None, whatever is given."""
        return None
