"""No refinement: the paper's "-wo"."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Pose, Rotation, Translation
from trihedron.plugins.mapping.reference_keyframe import transform_to_map
from trihedron.plugins.pose.decoupled_pose import decoupled_pose


@register("pose", "none")
@dataclass(frozen=True)
class NoRefinement:
    """The decoupled pose as it is (Table I, "Ours/-wo")."""

    def __call__(self, rotation: Rotation, translation: Translation, previous: Pose | None, map: Map | None, relocalise: Pose | None) -> Pose:
        """Return the decoupled pose; its status is that of rotation and translation."""
        previous, relocalise = (transform_to_map(pose, map) if pose is not None else None for pose in (previous, relocalise))
        return decoupled_pose(rotation, translation, previous, relocalise).to_pose(rotation, map)
