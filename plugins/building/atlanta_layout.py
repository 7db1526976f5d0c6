"""Rooms whose walls are upright and at any angle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Building, Frame, Map, Planes, Pose, Rotation
from trihedron.plugins.building.edits import apply_edits
from trihedron.plugins.building.layout import AtlantaOptions, atlanta_directions, plan_building
from trihedron.plugins.building.views import BuildingState, add_view, empty_state, preview_state


@register("building", "atlanta_layout")
@dataclass(frozen=True)
class AtlantaLayout(AtlantaOptions):
    """Extend `manhattan_layout` by further directions of walls: the peaks of the upright regions' normals about the vertical (Schindler, Dellaert,
    CVPR 2004, "Atlanta world"). An edge along none of the axes is turned to its own points."""

    def start(self) -> BuildingState:
        """Return an empty state, with the corrections by hand."""
        return empty_state(self)

    def add(self, state: BuildingState, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> BuildingState:
        """Retain the frame if it became a keyframe."""
        return add_view(self, state, frame, planes, rotation, pose, map)

    def preview(self, state: BuildingState) -> Building:
        """Return the plan so far of a few views, at their poses as they are now."""
        return self.finish(preview_state(state), state.map)

    def finish(self, state: BuildingState, map: Map | None) -> Building:
        """Return the plan at the final poses."""
        return apply_edits(plan_building(self, state, map, partial(atlanta_directions, self)), state.edits)
