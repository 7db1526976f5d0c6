"""The plan of a building: evidence, storeys, faces, free space, cells, rooms, walls and openings in turn.

A solver decides which cells are inside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, Range
from trihedron.pipeline.core.types import F64, Bool, Building, Map
from trihedron.plugins.building.assembly import StoreyPlan, assemble_building, empty_building
from trihedron.plugins.building.cell_complex import Cells, cells_of, inside_cells
from trihedron.plugins.building.doubts import doubts_of
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import faces_of, slanted_directions, upright_faces
from trihedron.plugins.building.free_space import free_space
from trihedron.plugins.building.jogs import SHORT_M, jog_sides
from trihedron.plugins.building.levels import Storey, in_storey, storeys_of
from trihedron.plugins.building.mirrors import mirrors_of, upright_readings, without_mirrors
from trihedron.plugins.building.openings import openings_of
from trihedron.plugins.building.rooms import rooms_of
from trihedron.plugins.building.tall_furniture import remove_furniture
from trihedron.plugins.building.views import BuildingState, LayoutOptions, gather_evidence
from trihedron.plugins.building.walls import walls_of

AXES = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])  # unit normals of faces along the building's two horizontal axes


def plan_building(
    options: LayoutOptions,
    state: BuildingState,
    map: Map | None,
    directions: Callable[[Evidence, Storey], F64],
    inside: Callable[[Cells], Bool] = inside_cells,
    remark: Callable[[Evidence, Storey], str] = lambda evidence, storey: "",
) -> Building:
    """Make the plan of each storey at the final poses: faces, free space, cells, and of those that are inside, rooms, walls and openings.

    `directions` returns the unit normals (d, 2) that faces may have, `inside` the cells (n,) that are inside, `remark` what cannot be shown."""
    evidence = gather_evidence(state, map)
    if evidence is None:
        return empty_building(state, "no plane was seen")
    storeys, plans = storeys_of(evidence), []
    for number, storey in enumerate(storeys):
        here = in_storey(evidence, storeys, number)
        axes = directions(here, storey)
        upright, readings = upright_faces(here, storey, axes), upright_readings(here, storey)
        space = free_space(here, storey)
        if mirrors := mirrors_of(upright, readings, space, storey):
            here = without_mirrors(here, mirrors)
            upright, readings, space = upright_faces(here, storey, axes), upright_readings(here, storey), free_space(here, storey)
        found = faces_of(upright, storey, space, min(SHORT_M, options.least_wall_m))
        faces, doubts = remove_furniture(found, here, storey, space, options.least_wall_m)
        faces += jog_sides(faces, here, space)
        cells = cells_of(faces, space)
        rooms = rooms_of(cells, inside(cells), faces, here, space, storey, options.least_room_m2)
        for room in rooms:
            room.doubts = doubts_of(room, doubts, space)
        walls = walls_of(rooms, faces, here, storey, options.least_wall_m)
        openings = openings_of(walls, rooms, faces, here, space, storey, readings)
        plans.append(StoreyPlan(storey, rooms, walls, openings, faces, remark(here, storey)))
    return assemble_building(state, evidence, plans, map)


@dataclass(frozen=True)
class AtlantaOptions(LayoutOptions):
    """Options of walls at any angle."""

    apart_deg: Annotated[float, Range(2, 45)] = 6.0  # between directions
    least_m2: PositiveFloat = 1.0  # of tall points of a direction


def atlanta_directions(options: AtlantaOptions, evidence: Evidence, storey: Storey) -> F64:
    """Return the unit normals (d, 2) of the axes and of the other peaks."""
    more = np.radians(slanted_directions(evidence, storey, options.apart_deg, options.least_m2))
    one = np.stack([np.cos(more), np.sin(more)], axis=1)
    return np.concatenate([AXES, one, -one])
