"""Rooms whose walls are at right angles."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Building, Frame, Map, Planes, Pose, Rotation
from trihedron.plugins.building.edits import apply_edits
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import slanted_directions
from trihedron.plugins.building.layout import AXES, plan_building
from trihedron.plugins.building.levels import Storey
from trihedron.plugins.building.views import BuildingState, LayoutOptions, add_view, empty_state, preview_state

APART_DEG, LEAST_M2 = 6.0, 3.0  # from the axes, and area of tall points of all views, for which a slanted wall is mentioned


@register("building", "manhattan_layout")
@dataclass(frozen=True)
class ManhattanLayout(LayoutOptions):
    """Cut the plan along the faces of walls in the two horizontal Manhattan axes; what rays passed is inside, what tall faces part are two rooms."""

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
        return apply_edits(plan_building(self, state, map, lambda evidence, storey: AXES, remark=slanted_walls), state.edits)


def slanted_walls(evidence: Evidence, storey: Storey) -> str:
    """Name walls along neither axis."""
    if not len(slanted_directions(evidence, storey, APART_DEG, LEAST_M2)):
        return ""
    return "walls at other than right angles were seen, which building=atlanta_layout lays out"
