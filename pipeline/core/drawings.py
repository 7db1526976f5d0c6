"""Drawings of values for viewers and pages: coloured triangles and labelled outlines, made by a function that a slot registers for its value
(`registry.register_drawing`). Only a slot knows how its building stands; a viewer knows triangles."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.types import F64, I32


@dataclass(frozen=True)
class Solid:
    """Triangles (t, 3) over vertices (v, 3) in the world, in metres; `name` may have parts, as `0/wall`; `rgba` are bytes."""

    name: str
    rgba: tuple[int, int, int, int]
    vertices_m: F64
    triangles: I32


@dataclass(frozen=True)
class Outline:
    """A closed line (n, 3) in the world, in metres, its first corner repeated at the end, and its label."""

    name: str
    label: str
    corners_m: F64


@dataclass(frozen=True)
class Drawing:
    """Solids and outlines of one value."""

    solids: tuple[Solid, ...] = ()
    outlines: tuple[Outline, ...] = ()
