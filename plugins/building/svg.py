"""The plan of a building as SVG; a point of the sheet is a pixel, a metre are PX of them."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.types import F64, Building
from trihedron.plugins.building.plan_drawing import draw_plan
from trihedron.plugins.building.sheet import FONTS, STYLES, Group, Letters, Mark, Shape

SVG = "floorplan.svg"
PX = 60.0


def write_svg(path: Path, building: Building, name: str = "") -> None:
    """Write the plan; `name` is that of the run, for the title."""
    write_file(path, floorplan_svg(building, name))


def floorplan_svg(building: Building, name: str = "") -> str:
    """Return the plan; `name` is that of the run, for the title."""
    sheet = draw_plan(building, PX, name)
    width, height = (f"{value:.0f}" for value in sheet.size)
    space = 'xmlns="http://www.w3.org/2000/svg" text-anchor="middle"'
    narrow = 'style="max-width:100%"'  # on a narrow screen the whole plan, smaller
    head = f'<svg {space} width="{width}" height="{height}" {narrow} viewBox="0 0 {width} {height}">'
    parts = [part for group in sheet.groups for part in _group(group)]
    return "\n".join([head, f"<style>{_style_sheet()}</style>", '<rect width="100%" height="100%" fill="#fff"/>', *parts, "</svg>", ""])


def _style_sheet() -> str:
    rules = ["text{font-family:Helvetica,Arial,sans-serif}"]
    for name, style in STYLES.items():
        dash = f";stroke-dasharray:{' '.join(f'{part:g}' for part in style.dash)}" if style.dash else ""
        rules.append(f".{name}{{fill:{style.fill or 'none'};stroke:{style.stroke or 'none'};stroke-width:{style.width:g}{dash}}}")
    for name, font in FONTS.items():
        rules.append(f".{'.'.join(name.split())}{{font-size:{font.size:g}px;fill:{font.color};font-weight:{'bold' if font.bold else 'normal'}}}")
    return "\n".join(["", *rules, ""])


def _group(group: Group) -> list[str]:
    marks = [_mark(mark) for mark in group.marks]
    return [f'<g id="{group.id}"><title>{escape(group.title)}</title>', *marks, "</g>"] if group.id else marks


def _mark(mark: Mark) -> str:
    if isinstance(mark, Shape):
        return f'<path class="{mark.style}" fill-rule="evenodd" d="{" ".join(_path(ring, mark.closed) for ring in mark.rings)}"/>'
    return _text(mark)


def _path(points: F64, closed: bool) -> str:
    return "M" + " L".join(f"{x:.1f} {y:.1f}" for x, y in points) + (" Z" if closed else "")


def _text(mark: Letters) -> str:
    x, y = (f"{value:.1f}" for value in mark.baseline())
    turn = f' transform="rotate({mark.angle_deg:g} {x} {y})"' if mark.angle_deg else ""
    anchor = ' text-anchor="start"' if mark.from_left else ""
    return f'<text class="{mark.font}" x="{x}" y="{y}"{anchor}{turn}>{escape(mark.text)}</text>'
