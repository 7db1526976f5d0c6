"""The kinds of landmarks, and the tables of a map by kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.types import I32, Map, Table


@dataclass(frozen=True)
class LandmarkKind:
    """A kind of landmark, by the columns that refer to it."""

    id_column: str  # of the kind's observation table: the landmark
    span_column: str  # of the keyframes' table: their rows of that one, half open


KINDS = POINT, LINE, PLANE = LandmarkKind("point", "points"), LandmarkKind("line", "lines"), LandmarkKind("plane", "planes")


def landmarks_of(map: Map) -> dict[LandmarkKind, Table]:
    """Return the map's landmarks by kind."""
    return {POINT: map.points, LINE: map.lines, PLANE: map.planes}


def observations_of(map: Map) -> dict[LandmarkKind, Table]:
    """Return the map's observations by kind."""
    return {POINT: map.point_observations, LINE: map.line_observations, PLANE: map.plane_observations}


def with_tables(map: Map, landmarks: Mapping[LandmarkKind, Table], observations: Mapping[LandmarkKind, Table] | None = None) -> Map:
    """Replace tables of landmarks and of observations; those of the other kinds remain."""
    points, lines, planes = {**landmarks_of(map), **landmarks}.values()
    of_points, of_lines, of_planes = {**observations_of(map), **(observations or {})}.values()
    return replace(
        map, points=points, lines=lines, planes=planes, point_observations=of_points, line_observations=of_lines, plane_observations=of_planes
    )


def observed_rows(map: Map, keyframes: I32, kind: LandmarkKind) -> tuple[I32, I32, I32]:
    """Return the observations by each keyframe in turn: their rows (o,), the ids of their landmarks (o,), and the number of each keyframe's (n,)."""
    spans = map.keyframes.rows(kind.span_column, keyframes)
    rows = np.concatenate([np.empty(0, np.int32), *(np.arange(begin, end, dtype=np.int32) for begin, end in spans)])
    return rows, observations_of(map)[kind].rows(kind.id_column, rows), spans[:, 1] - spans[:, 0]
