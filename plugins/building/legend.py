"""The legend below a plan: scale bar, north, areas and heights of storeys, what lines mean, and what the numbers on the plan stand for."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from datetime import datetime, timezone

import numpy as np

from trihedron.pipeline.core.descriptions import counted
from trihedron.pipeline.core.plan_areas import area_interval
from trihedron.pipeline.core.types import Building
from trihedron.plugins.building.geometry import rooms_on
from trihedron.plugins.building.sheet import FONTS, Group, Letters, Mark, Shape, line, text_from, width_of

MEANINGS = {
    "wall": "wall, seen",
    "completed": "wall, completed where it was not seen",
    "unseen": "not seen: nothing is known to bound the room there",
    "glass": "window",
    "swing": "door; which way it turns was not measured",
    "dimension": "between the inner faces of walls, m",
}
THIN = "thin walls: the other face was not seen"
FIGURES = "after ±: standard deviation; in parentheses: 95 % interval"
LINE, SWATCH, NARROWEST = 14.0, 26.0, 380.0  # points: between lines, wide a swatch, for the lines of text
SMALL = 20.0  # points a metre, of a scale whose bar is in steps of five metres
FIRST_DATE_S = 946684800  # 2000-01-01; stamps before it are no times of day


def title_of_plan(building: Building, name: str, scale: str) -> Letters:
    """Return the title: the run's name, the day (UTC) of the recording if its stamps tell one, and the scale."""
    seconds = building.stamp_ns // 1_000_000_000
    date = datetime.fromtimestamp(seconds, timezone.utc).strftime("%Y-%m-%d") if seconds >= FIRST_DATE_S else ""
    return text_from("title", ", ".join(filter(None, (f"Floor plan of {name}" if name else "Floor plan", date, scale))), 0.0, 0.0)


def legend_groups(building: Building, per_m: float, listed: list[str], width: float, styles: set[str]) -> list[Group]:
    """Draw the legend from (0, 0) downwards, about as wide as the plan, with the meaning of the styles that it uses."""
    marks: list[Mark] = list(_scale_bar(per_m))
    y = 3.2 * LINE
    wide = max(width, NARROWEST)
    sentences = [*storey_sentences(building), *([building.note] if building.note else [])]
    thin = "wall" in styles and bool(np.isnan(building.thickness_m).any())
    sentences += [*([THIN] if thin else []), *([FIGURES] if len(building.areas_m2) else [])]
    for text in [*sentences, *(f"{number}: {text}" for number, text in enumerate(listed, 1))]:
        for part in textwrap.wrap(text, int(wide / width_of("x", "note"))):
            marks.append(text_from("note", part, 0.0, y))
            y += LINE
    x = 0.0
    y += 0.3 * LINE
    for style in MEANINGS:
        if style in styles:
            needed = SWATCH + 6.0 + width_of(MEANINGS[style], "note")
            if x > 0.0 and x + needed > wide:
                x, y = 0.0, y + 1.2 * LINE
            marks += [*_swatch(style, x, y), text_from("note", MEANINGS[style], x + SWATCH + 6.0, y)]
            x += needed + 12.0
    return [Group(tuple(marks))]


def storey_sentences(building: Building) -> Iterator[str]:
    """Yield the area of each storey's floor with its 95 % interval, or how many walls were seen, and the heights of floor and ceiling."""
    for storey, (floor, ceiling) in enumerate(building.storeys):
        if rooms := rooms_on(building, storey):
            low, high = area_interval(building, *rooms)
            found = f"floor of storey {storey}: {building.areas_m2[rooms].sum():.2f} m² in {counted((len(rooms), 'room'))} ({low:.1f} to {high:.1f})"
        else:
            walls = int((building.wall_storeys == storey).sum())
            found = f"no room: {counted((walls, 'wall'))} that {'was' if walls == 1 else 'were'} seen"
            found = f"storey {storey}: {found}" if len(building.storeys) > 1 else found
        yield f"{found}; floor {_height(floor)}, ceiling {_height(ceiling)}"


def _height(value: float) -> str:
    return f"{value + 0.0:.2f} m".replace("-0.00", "0.00") if np.isfinite(value) else "not seen"


def _scale_bar(per_m: float) -> Iterator[Mark]:
    """Draw two metres, ten on a small scale, and north."""
    y, step = 0.8 * LINE, 1 if per_m > SMALL else 5
    yield line("scale", (0.0, y), (2 * step * per_m, y))
    for metres in (0, step, 2 * step):
        yield line("scale", (metres * per_m, y - 4.0), (metres * per_m, y + 4.0))
        yield Letters("length", f"{metres} m", np.array([metres * per_m, y + 12.0]))
    x = 2 * step * per_m + 60.0
    yield line("scale", (x, y + 4.0), (x, y - 20.0))
    yield line("scale", (x - 5.0, y - 10.0), (x, y - 20.0), (x + 5.0, y - 10.0))
    yield Letters("length", "N: first view", np.array([x, y + 12.0]))


def _swatch(style: str, x: float, y: float) -> Iterator[Mark]:
    """Draw a small piece of a style about the height y."""
    half = 0.3 * FONTS["note"].size
    if style in ("wall", "completed", "glass"):
        yield Shape(style, (np.array([[x, y - half], [x + SWATCH, y - half], [x + SWATCH, y + half], [x, y + half]]),))
    elif style == "swing":
        angles, radius = np.linspace(0.0, np.pi / 2.0, 10)[:, None], 3.5 * half
        hinge = np.array([x + 4.0, y + 1.7 * half])
        yield line("leaf", hinge, hinge - [0.0, radius])
        yield line("swing", *(hinge + radius * np.hstack([np.sin(angles), -np.cos(angles)])))
    else:
        yield line(style, (x, y), (x + SWATCH, y))
        if style == "dimension":
            for stop in (x + 3.0, x + SWATCH - 3.0):
                yield line("tick", (stop - 3.0, y + 3.0), (stop + 3.0, y - 3.0))
