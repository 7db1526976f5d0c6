"""No building."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Building, Map, Pose


@register("building", "none")
@dataclass(frozen=True)
class NoBuilding:
    """A plan without elements; the state is the last pose, whose index and stamp the plan bears."""

    def start(self) -> Pose | None:
        """Nothing seen yet."""
        return None

    def add(self, state: Pose | None, pose: Pose) -> Pose | None:
        """Remember the frame."""
        return pose

    def finish(self, state: Pose | None, map: Map | None) -> Building:
        """No storey, wall, room or opening."""
        index, stamp_ns = (state.index, state.stamp_ns) if state is not None else (0, 0)
        return Building.empty(index, stamp_ns, "no building was asked for")
