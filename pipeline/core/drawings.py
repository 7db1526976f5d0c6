"""Drawings of values for viewers and pages: coloured triangles and labelled outlines, made by a function that the slot of the value registers here.
Only a slot knows how its building stands; a viewer knows triangles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from trihedron.pipeline.core.types import F64, I32, Value


@dataclass(frozen=True)
class Solid:
    """Triangles (t, 3) over vertices (v, 3) in the world, in metres; `name` may have parts, as `0/wall`; `rgba` are bytes."""

    name: str
    rgba: tuple[int, int, int, int]
    vertices_m: F64
    triangles: I32


@dataclass(frozen=True)
class Outline:
    """A closed line (n, 3) in the world, in metres, its first corner repeated at the end, and what it says."""

    name: str
    label: str
    corners_m: F64


@dataclass(frozen=True)
class Drawing:
    """Solids and outlines of one value."""

    solids: tuple[Solid, ...] = ()
    outlines: tuple[Outline, ...] = ()


_DRAWN: dict[type[Value], Callable[[Any], Drawing]] = {}


def draws(kind: type[Value]) -> Callable[[Callable[[Any], Drawing]], Callable[[Any], Drawing]]:
    """Register the function that draws values of a type (decorator)."""

    def decorate(draw: Callable[[Any], Drawing]) -> Callable[[Any], Drawing]:
        _DRAWN[kind] = draw
        return draw

    return decorate


def drawing_of(value: Value) -> Drawing:
    """Return what is drawn of a value; nothing where the plugins of its slot are not loaded (`registry.load_plugins`)."""
    return _DRAWN[type(value)](value) if type(value) in _DRAWN else Drawing()
