"""Declarations beside a field's type: what its numbers may be, and what an index refers to.

`keypoints: Annotated[I32, Shape("n", 2), IndexInto("previous_keypoints", "keypoints")]` pairs rows of two inputs of the same stage. A plugin's own
values are not checked against them; values that come from a file are, in `pipeline.core.value_checks`, so that compiled kernels need no checks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class IndexInto:
    """Rows of another input of the same stage, by the name of its parameter (`keypoints`) or of a field of it (`map.points`), or of a field of the
    value itself (`.vertices_m`); one target for all numbers, or one for each column. A `+` behind it allows one more, for ends of half-open ranges
    and for numbers that count from 1. `least` is -1 where that stands for none."""

    targets: tuple[str, ...]
    least: int = 0

    def __init__(self, *targets: str, least: int = 0) -> None:
        object.__setattr__(self, "targets", targets)
        object.__setattr__(self, "least", least)


@dataclass(frozen=True)
class Within:
    """Numbers of a closed range; NaN is outside."""

    low: float
    high: float


@dataclass(frozen=True)
class OneOf:
    """Words."""

    words: tuple[str, ...]


@dataclass(frozen=True)
class Finite:
    """Numbers that are neither NaN nor infinite; `or_none`: a row may be NaN as a whole."""

    or_none: bool = False


@dataclass(frozen=True)
class Rotations:
    """Rotation matrices (..., 3, 3), or rigid motions (..., 4, 4); `or_none`: one may be NaN as a whole."""

    or_none: bool = False


@dataclass(frozen=True)
class UnitNormals:
    """Planes (..., 4) with |n| = 1."""


@dataclass(frozen=True)
class SameWidth:
    """Descriptors that are compared with those of other inputs, and so are of the same length wherever both have rows."""

    others: tuple[str, ...]


@dataclass(frozen=True)
class CoversImage:
    """A grid of cells of `stride` pixels with a cell for each pixel of the stage's frame."""


@dataclass(frozen=True)
class Columns:
    """Columns of a table: element type, shape of a row (None: any length) and constraints. Those of dead rows (`alive` False) are not checked."""

    columns: Mapping[str, tuple[Any, ...]]
