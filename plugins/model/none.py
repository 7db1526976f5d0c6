"""No dense model."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, PredictedView


@register("model", "none")
@dataclass(frozen=True)
class NoModel:
    """There is no predicted view to track against."""

    def __call__(self, frame: Frame) -> PredictedView | None:
        """None, whatever is given."""
        return None
