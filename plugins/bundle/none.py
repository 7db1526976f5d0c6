"""No bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Correction, Map


@register("bundle", "none")
@dataclass(frozen=True)
class NoBundle:
    """The map stays as tracking made it."""

    def __call__(self, map: Map) -> Correction | None:
        """None, whatever is given."""
        return None
