"""Precision and recall of rooms, corners and angles, as methods that are judged on Structured3D count them (Stekovic, Rad, Fraundorfer, Lepetit,
"MonteFloor", ICCV 2021, section 5; the same in RoomFormer and CAGE).

A room is right where it overlaps no other and its intersection over union with a true room is at least 0.5; one corner of a right room matches one of
the true room within 10 pixels of a picture of 256 that the plan fills, and its angle is right within 5° besides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from trihedron.pipeline.core.types import F64

ROOM_IOU = 0.5
CORNER_PX, PICTURE_PX = 10.0, 256.0
ANGLE_DEG = 5.0
OVERLAP = 0.05  # of a room by another, from which they overlap
STRAIGHT_DEG = 2.0  # a corner that turns by less is none


@dataclass(frozen=True)
class Score:
    """Elements that are right, that were found, and that there are."""

    right: int
    found: int
    true: int

    def __add__(self, other: Score) -> Score:
        """Count both."""
        return Score(self.right + other.right, self.found + other.found, self.true + other.true)

    @property
    def precision(self) -> float:
        """Return the share of those found that are right, NaN for none."""
        return self.right / self.found if self.found else float("nan")

    @property
    def recall(self) -> float:
        """Return the share of the true ones that were found, NaN for none."""
        return self.right / self.true if self.true else float("nan")

    @property
    def f1(self) -> float:
        """Return the harmonic mean of precision and recall, 0 where nothing is right, NaN where there is nothing."""
        return 2.0 * self.right / (self.found + self.true) if self.found + self.true else float("nan")


def floorplan_scores(found: list[Any], true: list[Any]) -> dict[str, Score]:
    """Judge the rooms of one storey, shapely polygons in metres; returns the scores of "room", "corner" and "angle"."""
    shapes = [room.bounds for room in true]
    size = max(max(b[2] for b in shapes) - min(b[0] for b in shapes), max(b[3] for b in shapes) - min(b[1] for b in shapes)) if shapes else 1.0
    near = CORNER_PX / PICTURE_PX * size
    mine, theirs = [_corners(room) for room in found], [_corners(room) for room in true]
    rooms = corners = angles = 0
    for k, other in _matches(found, true):
        rooms += 1
        for i, j in _nearest_pairs(mine[k][0], theirs[other][0], near):
            corners += 1
            angles += abs(mine[k][1][i] - theirs[other][1][j]) <= ANGLE_DEG
    counts = sum(len(points) for points, _ in mine), sum(len(points) for points, _ in theirs)
    return {"room": Score(rooms, len(found), len(true)), "corner": Score(corners, *counts), "angle": Score(angles, *counts)}


def _matches(found: list[Any], true: list[Any]) -> list[tuple[int, int]]:
    """Match found rooms that overlap no other with true ones, the best first."""
    alone = [
        k for k, room in enumerate(found) if all(room.intersection(other).area <= OVERLAP * room.area for i, other in enumerate(found) if i != k)
    ]
    overlap = [(found[k].intersection(room).area / found[k].union(room).area, k, j) for k in alone for j, room in enumerate(true)]
    return _one_to_one(sorted((item for item in overlap if item[0] >= ROOM_IOU), reverse=True))


def _nearest_pairs(mine: F64, theirs: F64, near: float) -> list[tuple[int, int]]:
    """Match corners (n, 2) with true ones (m, 2) within a distance, the nearest first."""
    away = np.linalg.norm(mine[:, None] - theirs[None], axis=2)
    return _one_to_one(sorted((float(away[i, j]), int(i), int(j)) for i, j in zip(*np.nonzero(away <= near))))


def _one_to_one(ranked: list[tuple[float, int, int]]) -> list[tuple[int, int]]:
    """Take pairs in order, each element once."""
    pairs: list[tuple[int, int]] = []
    for _, i, j in ranked:
        if all(i != a and j != b for a, b in pairs):
            pairs.append((i, j))
    return pairs


def _corners(room: Any) -> tuple[F64, F64]:
    """Return the corners (n, 2) of a room's rings and the angles (n,) within the room at them, degrees, without those on a straight line."""
    import shapely

    points, angles = [], []
    for polygon in getattr(room, "geoms", [room]):
        polygon = shapely.geometry.polygon.orient(polygon)
        for ring in (polygon.exterior, *polygon.interiors):
            corners = np.array(ring.coords)[:-1]
            before, after = np.roll(corners, 1, axis=0) - corners, np.roll(corners, -1, axis=0) - corners
            turn = np.degrees(np.arctan2(before[:, 1], before[:, 0]) - np.arctan2(after[:, 1], after[:, 0])) % 360.0
            kept = np.abs(turn - 180.0) > STRAIGHT_DEG
            points.append(corners[kept])
            angles.append(turn[kept])
    return np.concatenate(points), np.concatenate(angles)
