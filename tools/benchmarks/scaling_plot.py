"""The picture of `trihedron benchmark scaling`: small multiples, a column for each part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import new_file

AXES = {"threads": "threads", "image": "image width, px", "features": "key points", "map": "points in the map", "length": "frames walked"}
ALL, AFTER, BETWEEN, MULTIPLE, MEMORY = "tab:blue", "tab:green", "tab:red", "tab:purple", "tab:orange"
WIDTH_IN, HEIGHT_IN, DPI, FONT_PT = 1.8, 5.6, 100, 8  # of a column, of the picture
Rows = Sequence[Mapping[str, Any]]


def plot(parts: Mapping[str, Rows], path: Path) -> None:
    """Write it as a PNG. Raises DataError when it cannot be written."""
    try:
        with new_file(path) as new:
            figure_of(parts).savefig(new, format="png", dpi=DPI)
    except OSError as error:
        raise DataError(str(path), f"cannot be written ({error.strerror})", "give a file in a folder that exists") from error


def figure_of(parts: Mapping[str, Rows]) -> Any:
    """Draw, from above: ms of a frame's stages, these as multiples of the reference workload, memory. The rows of panels share their scale,
    which begins at zero; what is varied is on a logarithmic one, marked where it was measured."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"font.size": FONT_PT, "lines.markersize": 4}):
        figure = Figure(figsize=(WIDTH_IN * max(len(parts), 2), HEIGHT_IN), layout="constrained")
        grid = figure.subplots(3, len(parts), squeeze=False, sharey="row", sharex="col")
        for column, (part, rows) in enumerate(parts.items()):
            _draw(grid[:, column], part, rows)
        for axes, label in zip(grid[:, 0], ("time of a frame, ms", "all stages, × reference", "memory, MB")):
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0.0)
        figure.legend(handles=max((axes.lines for axes in grid[0]), key=len), loc="outside upper center", ncols=3, frameon=False)
        figure.align_ylabels(grid[:, 0])
    return figure


def _draw(panels: Any, part: str, rows: Rows) -> None:
    """The three panels of a part."""
    places = [place(part, row) for row in rows]
    panels[0].plot(places, [row["frame_ms"] for row in rows], "o-", color=ALL, label="all stages")
    panels[0].plot(places, [row["after_features_ms"] for row in rows], "s--", color=AFTER, label="those after the features")
    if part == "threads":
        panels[0].plot(places, [1e3 / row["fps"] for row in rows], "^:", color=BETWEEN, label="from frame to frame, with its rendering (threads)")
    panels[1].plot(places, [row["frame_ms"] / row["reference_ms"] for row in rows], "o-", color=MULTIPLE)
    panels[2].plot(places, [row["memory_mb"] for row in rows], "o-", color=MEMORY)
    panels[2].set(xlabel=AXES[part], xscale="log")
    panels[2].set_xticks(places, [f"{at:.0f}" if at < 1e4 else f"{at / 1e3:.0f}k" for at in places])
    panels[2].set_xticks([], minor=True)
    for axes in panels:
        axes.margins(x=0.12, y=0.1)
        axes.grid(alpha=0.3)


def place(part: str, row: Mapping[str, Any]) -> float:
    """Position of a row on its axis: the map by what it holds, an image by its width, all else by the row's name."""
    return float(row["points"]) if part == "map" else float(row["name"].partition("x")[0])
