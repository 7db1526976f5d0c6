"""The sheet on which a plan is drawn, before it is a file: areas, lines and letters in points of paper, x to the right and y down.

The letters are as large on every scale, so what is written where depends on it; their widths are estimates for fonts of usual breadth."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.types import F64


@dataclass(frozen=True)
class Style:
    """The look of an area or a line; a colour that is empty is none."""

    fill: str = ""
    stroke: str = ""
    width: float = 1.0
    dash: tuple[float, ...] = ()


@dataclass(frozen=True)
class Font:
    """The look of letters; `size` in points."""

    size: float
    bold: bool = False
    color: str = "#222222"


STYLES = {
    "room": Style(fill="#eef3f8"),
    "wall": Style(fill="#333333", stroke="#333333", width=0.8),
    "completed": Style(fill="#ffffff", stroke="#333333", dash=(4.0, 2.5)),
    "unseen": Style(stroke="#cc3333", width=2.0, dash=(7.0, 5.0)),
    "leaf": Style(stroke="#555555", width=1.8),
    "swing": Style(stroke="#777777", width=0.8),
    "glass": Style(fill="#ffffff", stroke="#3388cc", width=1.3),
    "dimension": Style(stroke="#666666", width=0.6),
    "tick": Style(stroke="#222222", width=1.2),
    "scale": Style(stroke="#222222"),
}
FONTS = {
    "title": Font(14.0, True),
    "name": Font(12.0, True),
    "area": Font(10.5),
    "name small": Font(8.0, True),
    "area small": Font(7.5),
    "length": Font(8.5, color="#444444"),
    "height": Font(6.5, color="#444444"),
    "note": Font(10.0),
}
WIDE, NARROW, BOLD = 1.0, 0.6, 1.1  # ems that a letter takes: of East Asia, others; times as much where it is bold
BOX = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
BASELINE = 0.35  # of the size, below the middle of a line


def width_of(text: str, font: str) -> float:
    """Return about the width of a line of text."""
    ems = sum(WIDE if unicodedata.east_asian_width(letter) in "WF" else NARROW for letter in text)
    return ems * FONTS[font].size * (BOLD if FONTS[font].bold else 1.0)


@dataclass(frozen=True)
class Shape:
    """An area between rings (n, 2), or a line (n, 2) that is not closed."""

    style: str
    rings: tuple[F64, ...]
    closed: bool = True

    def moved(self, by: F64) -> Shape:
        """Return it elsewhere."""
        return replace(self, rings=tuple(ring + by for ring in self.rings))

    def corners(self) -> F64:
        """Return points (n, 2) in whose bounds it lies."""
        return np.concatenate(self.rings)


@dataclass(frozen=True)
class Letters:
    """A line of text about its middle, turned clockwise; a file sets it from its left end, or about its middle."""

    font: str
    text: str
    middle: F64
    angle_deg: float = 0.0
    from_left: bool = False

    def moved(self, by: F64) -> Letters:
        """Return it elsewhere."""
        return replace(self, middle=self.middle + by)

    def corners(self) -> F64:
        """Return the corners (4, 2) of its box."""
        half = np.array([width_of(self.text, self.font), FONTS[self.font].size]) / 2.0
        along, down = _turn(self.angle_deg).T * half[:, None]
        return np.asarray(self.middle + BOX[:, :1] * along + BOX[:, 1:] * down)

    def box(self) -> Any:
        """Return its box as a polygon of shapely."""
        import shapely

        return shapely.Polygon(self.corners())

    def baseline(self) -> F64:
        """Return the place (2,) on its base line from which, or about which, a file sets it."""
        along, down = _turn(self.angle_deg).T
        back = width_of(self.text, self.font) / 2.0 if self.from_left else 0.0
        return np.asarray(self.middle - back * along + BASELINE * FONTS[self.font].size * down)


def _turn(angle_deg: float) -> F64:
    """Return a clockwise turn (2, 2)."""
    angle = np.radians(angle_deg)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


Mark = Shape | Letters


@dataclass(frozen=True)
class Group:
    """Marks that draw an element, under its id and with a title; without an id they are no element's."""

    marks: tuple[Mark, ...]
    id: str = ""
    title: str = ""


@dataclass(frozen=True)
class Sheet:
    """Groups on paper of a size (width, height)."""

    size: F64
    groups: tuple[Group, ...]

    def marks(self) -> Iterator[Mark]:
        """Yield all marks."""
        for group in self.groups:
            yield from group.marks


def line(style: str, *points: Any) -> Shape:
    """Return a line through points."""
    return Shape(style, (np.array(points, np.float64).reshape(-1, 2),), closed=False)


def text_from(font: str, text: str, x: float, y: float) -> Letters:
    """Return a line of text that begins at x, with its middle at the height y."""
    return Letters(font, text, np.array([x + width_of(text, font) / 2.0, y]), from_left=True)


def moved(groups: Iterable[Group], by: F64) -> list[Group]:
    """Return groups elsewhere."""
    return [replace(group, marks=tuple(mark.moved(by) for mark in group.marks)) for group in groups]


def bounds(groups: Iterable[Group]) -> tuple[F64, F64]:
    """Return the least and the greatest corner (2,) of what is drawn; zeros where nothing is."""
    found = [mark.corners() for group in groups for mark in group.marks]
    points = np.concatenate(found) if found else np.zeros((1, 2))
    return points.min(axis=0), points.max(axis=0)
