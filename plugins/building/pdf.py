"""The plan of a building as PDF, exactly to scale: 1:50, else 1:100, else 1:200, on A4 where that is enough, else on A3."""

from __future__ import annotations

import io
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.core.types import F64, Building
from trihedron.plugins.building.plan_drawing import EDGE, draw_plan
from trihedron.plugins.building.sheet import FONTS, STYLES, Letters, Shape, Sheet

PDF = "floorplan.pdf"
POINT_M = 0.0254 / 72.0
SCALES = (50, 100, 200)
PAPERS_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0)}
MARGIN_MM = 10.0


def write_pdf(path: Path, building: Building, name: str = "") -> None:
    """Write the plan; `name` is that of the run, for the title. Raises LibraryError where matplotlib is not installed."""
    with imports_of("matplotlib"):
        from matplotlib import rc_context
        from matplotlib.backends.backend_pdf import FigureCanvasPdf
        from matplotlib.figure import Figure
    sheet, page = fitted(building, name)
    content = io.BytesIO()
    with rc_context({"pdf.fonttype": 42, "font.family": "DejaVu Sans"}):
        figure = Figure(figsize=tuple(page / 72.0))
        FigureCanvasPdf(figure)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, page[0]), ylim=(page[1], 0.0))
        axes.set_axis_off()
        for order, mark in enumerate(sheet.marks()):
            _draw(axes, mark.moved((page - sheet.size) / 2.0), order)
        figure.savefig(content, format="pdf", metadata={"CreationDate": None, "Title": "Floor plan"})
    write_file(path, content.getvalue())


def fitted(building: Building, name: str) -> tuple[Sheet, F64]:
    """Return the plan at the largest of SCALES that fits a paper, and the size (2,) of the smallest that it fits, points; where none does, at the
    smallest scale on a page as large as it needs."""
    for scale, (paper, size_mm) in product(SCALES, PAPERS_MM.items()):
        sheet = draw_plan(building, 1.0 / (scale * POINT_M), name, f"1:{scale} on {paper}")
        for page_mm in (size_mm, size_mm[::-1]):
            page = np.array(page_mm) * 0.001 / POINT_M
            if (sheet.size <= page - 2.0 * _margin()).all():
                return sheet, page
    sheet = draw_plan(building, 1.0 / (SCALES[-1] * POINT_M), name, f"1:{SCALES[-1]}")
    return sheet, sheet.size + 2.0 * _margin()


def _margin() -> float:
    """Return what is to be left free round a sheet, which has an edge of its own, points."""
    return MARGIN_MM * 0.001 / POINT_M - EDGE


def _draw(axes: Any, mark: Shape | Letters, order: int) -> None:
    """Draw a mark above those before it."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    if isinstance(mark, Letters):
        font, (x, y) = FONTS[mark.font], mark.baseline()
        look = {"fontsize": font.size, "fontweight": "bold" if font.bold else "normal", "color": font.color, "parse_math": False}
        place = {"ha": "left" if mark.from_left else "center", "va": "baseline", "rotation": -mark.angle_deg, "rotation_mode": "anchor"}
        axes.text(x, y, mark.text, zorder=order, **look, **place)
        return
    style = STYLES[mark.style]
    rings = [np.concatenate([ring, ring[:1]]) if mark.closed else ring for ring in mark.rings]
    outline = Outline.make_compound_path(*(Outline(ring, closed=mark.closed) for ring in rings))
    dash = (0.0, tuple(part / style.width for part in style.dash)) if style.dash else "solid"  # matplotlib's are in widths of the line
    line = {"edgecolor": style.stroke or "none", "linewidth": style.width if style.stroke else 0.0, "linestyle": dash, "capstyle": "butt"}
    axes.add_patch(PathPatch(outline, facecolor=style.fill or "none", zorder=order, **line))
