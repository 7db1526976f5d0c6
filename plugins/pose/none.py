"""No refinement: the paper's "-wo"."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Pose, Rotation, Translation
from trihedron.plugins.mapping.reference_keyframe import anchored, decoupled_pose


@register("pose", "none")
@dataclass(frozen=True)
class NoRefinement:
    """The decoupled pose as it is (Table I, "Ours/-wo")."""

    def __call__(
        self, rotation: Rotation, translation: Translation, previous: Pose | None, map: Map | None, relocalise: Pose | None
    ) -> Pose:
        """The decoupled pose; status from whether this frame's features determined it."""
        previous, relocalise = (anchored(said, map) if said is not None else None for said in (previous, relocalise))
        return decoupled_pose(rotation, translation, previous, relocalise).said(rotation, map)
