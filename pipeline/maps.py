"""The types of the topics `map`, `bundle` and `loop`: the map and what corrects it."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

from trihedron.pipeline.arrays import F32, F64, I32, Shape, Value
from trihedron.pipeline.table import Table


@dataclass(frozen=True)
class Map(Value):
    """Keyframes and landmarks; a row number is an id for good, dead rows have `alive` False. Columns are listed in `plugins.numerics.maps.landmarks`.

    `revision` counts versions; `point_observations` and its siblings say which keyframe (row) saw which landmark, and what it measured."""

    version: ClassVar[int] = 4
    revision: int
    keyframes: Table
    points: Table
    lines: Table
    planes: Table
    point_observations: Table
    line_observations: Table
    plane_observations: Table

    @cached_property
    def memo(self) -> dict[Hashable, Any]:
        """What was worked out of this version and is asked for frame after frame; gone with it, and no part of the value."""
        return {}


@dataclass(frozen=True)
class Correction(Value):
    """Moves keyframes and landmarks of the map, by id, as bundle adjustment or loop closing found them from revision `based_on`. `*_information`
    (world, 1/m²; of each end of a line) and `plane_covariance`, of (a, b, d), replace what the map had gathered: no measurement is counted twice."""

    version: ClassVar[int] = 2

    based_on: int
    keyframe_ids: Annotated[I32, Shape("k")]
    T_world_keyframe: Annotated[F64, Shape("k", 4, 4)]
    point_ids: Annotated[I32, Shape("n")]
    points_m: Annotated[F64, Shape("n", 3)]
    point_information: Annotated[F32, Shape("n", 3, 3)]
    line_ids: Annotated[I32, Shape("m")]
    endpoints_m: Annotated[F64, Shape("m", 2, 3)]
    line_information: Annotated[F32, Shape("m", 2, 3, 3)]
    plane_ids: Annotated[I32, Shape("p")]
    coefficients: Annotated[F64, Shape("p", 4)]
    plane_covariance: Annotated[F64, Shape("p", 3, 3)]
