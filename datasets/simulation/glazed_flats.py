"""Flats with mirrors and glass. Metres, z up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.datasets.simulation.buildings import Building, wall_with_gaps
from trihedron.datasets.simulation.flats import random_flat
from trihedron.datasets.simulation.room import HEIGHT_M, UP, Face, Glass, Pane, Solid, pane_before
from trihedron.pipeline.core.linalg import matmul, norm

WARDROBE_M, WINDOW_WIDE_M, PORTRAIT_WIDE_M = 1.7, 1.2, 0.6  # by which fronts of wardrobes, windows and portraits are known


def glazed_flat(number: int) -> Building:
    """Make flat `number` with mirrors on doors of wardrobes, in frames of pictures and from the floor up, and glass in its windows and between
    rooms."""
    flat, rng = random_flat(number), np.random.default_rng([number, 47])
    solids, panes = list[Solid](), list[Pane]()
    for solid in flat.room.solids:
        window = _window_in(rng, solid, flat.room.solids)
        solids += window[0] if window else [solid]
        panes += window[1] if window else []
    solids = [solid for solid in solids if not any(_hangs_over(solid, pane) for pane in panes)]
    for front in (face for solid in solids for face in solid.faces):
        width, height = front.size_m
        if front.material == "drawers" and height > WARDROBE_M and rng.uniform() < 0.6:
            panes.append(_mirror_door(front, rng.uniform() < 0.5))
        elif front.material == "picture" and width > WINDOW_WIDE_M:
            panes.append(pane_before(front, Glass.outer))
        elif front.material == "picture" and width < PORTRAIT_WIDE_M and rng.uniform() < 0.25:
            panes.append(_standing_mirror(front))
        elif front.material == "picture" and rng.uniform() < 0.15:
            panes.append(pane_before(front, Glass.mirror))
    return replace(flat, room=replace(flat.room, solids=tuple(solids), panes=tuple(panes)))


def _hangs_over(solid: Solid, pane: Pane) -> bool:
    """Say if a picture hangs where there is a window now."""
    away = np.abs(matmul(np.stack([pane.u, pane.normal]), solid.centre - pane.origin - pane.u * pane.size_m[0] / 2.0))
    return any(face.material == "picture" for face in solid.faces) and bool(away[0] < pane.size_m[0] / 2.0 + solid.half[0] and away[1] < 0.15)


def _mirror_door(face: Face, left: bool) -> Pane:
    """Make the mirror on one of the two doors of a wardrobe."""
    pane = pane_before(face, Glass.mirror)
    half = pane.size_m[0] / 2.0
    return replace(pane, origin=pane.origin + (0.0 if left else half) * pane.u, size_m=(half, pane.size_m[1]))


def _standing_mirror(face: Face) -> Pane:
    """Make a mirror of 0.7 m from near the floor to above one's head, where a portrait hangs."""
    wide, bottom, top = 0.7, 0.1, 1.95
    middle = face.origin + face.u * face.size_m[0] / 2.0 + 0.005 * face.normal
    return Pane(Glass.mirror, middle - face.u * wide / 2.0 + UP * (top - middle[2]), face.u, face.v, face.normal, (wide, top - bottom))


def _window_in(rng: np.random.Generator, wall: Solid, others: tuple[Solid, ...]) -> tuple[list[Solid], list[Pane]] | None:
    """Return a partition with a window of 1 m by 1.1 m in its middle instead, and its pane, where nothing stands or hangs there; else None."""
    long = int(np.argmax(wall.half[:2]))
    length, thick = 2.0 * float(wall.half[long]), 2.0 * float(wall.half[1 - long])
    partition = all(face.material == "wall" for face in wall.faces) and length > 1.6 and thick < 0.2 and wall.half[2] * 2.0 > HEIGHT_M - 1e-6
    if not partition or rng.uniform() < 0.3:
        return None
    along, across = wall.R_world_solid[:, long], wall.R_world_solid[:, 1 - long]
    standing = [solid for solid in others if min(solid.half[:2]) > 0.02 and solid is not wall]
    near = np.abs(matmul(np.array([solid.centre - wall.centre for solid in standing]), np.stack([along, across], axis=1)))
    reach = np.array([float(norm(solid.half[:2])) for solid in standing])
    if ((near[:, 0] < 0.6 + reach) & (near[:, 1] < 0.2 + reach) & (reach < length / 2.0)).any():
        return None
    wide, bottom, top = 1.0, 0.9, 2.0
    ends = wall.centre[:2] + np.array([[-0.5], [0.5]]) * length * along[:2]
    solids = wall_with_gaps((ends[0, 0], ends[0, 1]), (ends[1, 0], ends[1, 1]), [(length / 2.0, wide, bottom, top)], thick)
    corner = np.array([*wall.centre[:2], 0.0]) - along * wide / 2.0 + UP * top
    return solids, [Pane(Glass.inner, corner, along, -UP, across, (wide, top - bottom))]
