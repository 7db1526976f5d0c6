"""The rows of `trihedron compare` as text, Markdown, LaTeX, CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]
TRACKED, COMPARED = "tracked %", "ATE mm"
MEAN = f"{COMPARED} mean, 95 %"
TRACKED_SLACK = 5.0  # percent of the frames: an error over fewer of them is no better
LATEX = {"%": r"\%", "&": r"\&", "_": r"\_", "#": r"\#", "±": r"$\pm$", "°": r"$^\circ$"}


@dataclass(frozen=True)
class Figure:
    """A column: what a value in SI units (or ms) is multiplied with, its decimals, and whether more is better."""

    factor: float
    decimals: int
    more: bool = False
    error: bool = False  # means nothing over a part of the frames


FIGURES = {
    TRACKED: Figure(100.0, 1, more=True),
    COMPARED: Figure(1e3, 2, error=True),
    "RPE 1 s mm": Figure(1e3, 2, error=True),
    "RPE 1 s deg": Figure(1.0, 3, error=True),
    "end to start mm": Figure(1e3, 1, error=True),
    "surface mm": Figure(1e3, 2, error=True),
    "within 5 cm %": Figure(100.0, 1, more=True),
    "p50 ms": Figure(1.0, 1),
    "p95 ms": Figure(1.0, 1),
    "memory MB": Figure(1.0, 0),
}


@dataclass(frozen=True)
class Cell:
    """A text, and whether it is the best of its column."""

    text: str
    best: bool = False


def cells_of(rows: Sequence[Row]) -> tuple[list[str], list[list[Cell]]]:
    """Header and cells; columns in which no row has anything are left out."""
    shown = [name for name in FIGURES if any(name in row["figures"] for row in rows)]
    data, compared, notes = len({row["data"] for row in rows}) > 1, any(row["difference"] for row in rows), any(row["note"] for row in rows)
    repeated = any(row["figures"].get(COMPARED, {}).get("half") is not None for row in rows)
    added = [name for name, there in ((MEAN, repeated), (f"{COMPARED} - baseline", compared), ("note", notes)) if there]
    header = [*(["data"] if data else []), "change", "runs", *shown, *added]
    best = {(row["data"], name): _best([other for other in rows if other["data"] == row["data"]], name) for row in rows for name in shown}
    cells = []
    for row in rows:
        line = [*([Cell(row["data"] or "-")] if data else []), Cell(row["change"] or "-"), Cell(str(row["runs"]))]
        line += [_cell(row, name, best[row["data"], name]) for name in shown]
        line += [Cell(_mean(row["figures"].get(COMPARED)))] if repeated else []
        line += [Cell(_difference(row["difference"].get(COMPARED)))] if compared else []
        cells.append([*line, Cell(row["note"])] if notes else line)
    return header, cells


def _best(rows: Sequence[Row], name: str) -> str | None:
    """Best value of a column; None when fewer than two rows compete, or the runs of another row reach into those of the best: that is noise."""
    figure = FIGURES[name]
    competing = [row for row in rows if name in row["figures"]]
    if figure.error:
        most = max((row["figures"].get(TRACKED, {"median": 0.0})["median"] for row in competing), default=0.0)
        competing = [row for row in competing if _tracked_share(row) >= most - TRACKED_SLACK]
    found = sorted((row["figures"][name] for row in competing), key=lambda one: -one["median"] if figure.more else one["median"])
    if len(found) < 2:
        return None
    text = f"{found[0]['median']:.{figure.decimals}f}"
    others = [one for one in found[1:] if f"{one['median']:.{figure.decimals}f}" != text]
    return None if any(one["min"] <= found[0]["max"] and found[0]["min"] <= one["max"] for one in others) else text


def _tracked_share(row: Row) -> float:
    return float(row["figures"].get(TRACKED, {"median": 0.0})["median"])


def _cell(row: Row, name: str, best: str | None) -> Cell:
    text = figure_text(row, name)
    return Cell(text, best is not None and text.partition(" ")[0] == best)


def figure_text(row: Row, name: str) -> str:
    """Return the median of a row's figure ± half the distance from the smallest to the largest; - where there is none."""
    return spread_text(row["figures"][name], FIGURES[name].decimals) if name in row["figures"] else "-"


def spread_text(found: dict[str, Any], decimals: int) -> str:
    """Return a median ± half the distance from the smallest to the largest value, if there are several."""
    spread = f" ±{0.5 * (found['max'] - found['min']):.{decimals}f}" if found["runs"] > 1 else ""
    return f"{found['median']:.{decimals}f}{spread}"


def _mean(found: dict[str, Any] | None) -> str:
    if found is None or found["half"] is None:
        return "-"
    decimals = FIGURES[COMPARED].decimals
    return f"{found['mean']:.{decimals}f} ±{found['half']:.{decimals}f}"


def _difference(found: dict[str, Any] | None) -> str:
    if found is None:
        return "-"
    decimals = FIGURES[COMPARED].decimals
    interval = "" if found["low"] is None else f" [{found['low']:+.{decimals}f}, {found['high']:+.{decimals}f}]"
    return f"{found['mean']:+.{decimals}f}{interval}"


def as_text(rows: Sequence[Row], bold: bool | None = None) -> str:
    """Aligned columns; the best are bold on a terminal."""
    header, cells = cells_of(rows)
    bold = sys.stdout.isatty() if bold is None else bold
    widths = [max(len(line[i]) for line in [header, *([cell.text for cell in row] for row in cells)]) for i in range(len(header))]
    left = {i for i, name in enumerate(header) if name in ("data", "change", "note")}
    lines = ["  ".join(_align_cell(name, w, i in left) for i, (name, w) in enumerate(zip(header, widths))).rstrip()]
    for row in cells:
        padded = [_align_cell(cell.text, w, i in left) for i, (cell, w) in enumerate(zip(row, widths))]
        lines.append("  ".join(f"\033[1m{text}\033[0m" if cell.best and bold else text for cell, text in zip(row, padded)).rstrip())
    return "\n".join(lines)


def _align_cell(text: str, width: int, left: bool) -> str:
    return text.ljust(width) if left else text.rjust(width)


def as_markdown(rows: Sequence[Row], verdicts: Sequence[str] = ()) -> str:
    """The verdicts as a list, if there are any, and a table of Markdown, best in bold."""
    header, cells = cells_of(rows)
    rule = [":--" if name in ("data", "change", "note") else "--:" for name in header]
    lines = [header, rule, *([f"**{cell.text}**" if cell.best else cell.text.replace("|", "\\|") for cell in row] for row in cells)]
    listed = "".join(f"- {line.replace('|', chr(92) + '|')}\n" for line in verdicts)
    return listed + "\n" * bool(listed) + "".join("| " + " | ".join(line) + " |\n" for line in lines)


def as_latex(rows: Sequence[Row], verdicts: Sequence[str] = ()) -> str:
    """A tabular of LaTeX, best in bold; without the verdicts."""
    header, cells = cells_of(rows)
    columns = "".join("l" if name in ("data", "change", "note") else "r" for name in header)
    body = [
        [_escape_latex(name) for name in header],
        *([rf"\textbf{{{_escape_latex(c.text)}}}" if c.best else _escape_latex(c.text) for c in row] for row in cells),
    ]
    lines = [" & ".join(line) + r" \\" for line in body]
    return "\n".join([rf"\begin{{tabular}}{{{columns}}}", r"\hline", lines[0], r"\hline", *lines[1:], r"\hline", r"\end{tabular}", ""])


def _escape_latex(text: str) -> str:
    return "".join(LATEX.get(letter, letter) for letter in text)


def as_csv(rows: Sequence[Row], verdicts: Sequence[str] = ()) -> str:
    """A line for each row: median, smallest and largest of each figure, the differences with their intervals, and the verdict's answer on each."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        ["data", "change", "runs", "note", *(f"{name} {part}" for name in FIGURES for part in ("median", "min", "max"))]
        + [f"{name} - baseline {part}" for name in FIGURES for part in ("mean", "low", "high")]
        + [f"{name} verdict" for name in FIGURES]
    )
    for row in rows:
        figures = [row["figures"].get(name, {}).get(part, "") for name in FIGURES for part in ("median", "min", "max")]
        differences = [row["difference"].get(name, {}).get(part) for name in FIGURES for part in ("mean", "low", "high")]
        answers = [row["verdicts"].get(name, {}).get("answer", "") for name in FIGURES]
        shown = ["" if value is None else value for value in differences]
        writer.writerow([row["data"], row["change"], row["runs"], row["note"], *figures, *shown, *answers])
    return out.getvalue()


def as_json(rows: Sequence[Row], verdicts: Sequence[str] = ()) -> str:
    """The rows as they are, which hold their verdicts."""
    return json.dumps(list(rows), indent=2) + "\n"


WRITERS: dict[str, Callable[[Sequence[Row], Sequence[str]], str]] = {"csv": as_csv, "markdown": as_markdown, "latex": as_latex, "json": as_json}
