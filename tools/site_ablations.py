"""The page of an ablation among the pages of results, from the ablation.json of a folder: verdicts, each figure with its 95 % intervals, attribution,
errors over time, the worst frames, and the command that computes it again."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison import ablation_tables as tables
from trihedron.comparison.ablation_tables import RESULT, Case, Variant, by_change, number
from trihedron.comparison.frame_errors import errors_file, read_errors
from trihedron.comparison.swaps import AS_RECORDED
from trihedron.comparison.verdicts import NOTE, Verdict, line_of
from trihedron.pipeline.core.config import Feedback
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.sweep.paired_statistics import half_interval
from trihedron.tools.page_figures import MOST_CURVES, Figure, curves_figure, embed_picture, look_of
from trihedron.tools.pages import render

SHOWN = ("ATE mm", "RPE 1 frame mm", "RPE 1 s mm", "axes deg", "rotation deg", "translation mm", "ms")
MARGIN = 4.0  # of a chart, per cent of its width, on both sides
LOOPS = {Feedback.new.name: "closed loop", Feedback.recorded.name: "open loop"}


@dataclass(frozen=True)
class Ablation:
    """The cases of an ablation that have the same alternatives, of one folder or several recordings; `name` is that of its page's file."""

    name: str
    title: str
    cases: tuple[Case, ...]

    @property
    def command(self) -> str:
        """The command that computes it again, into a folder `again`; empty where an older version recorded no words."""
        first = self.cases[0]
        if not first.swaps:
            return ""
        feedback = [f"feedback={first.feedback}"] if first.feedback != Feedback.new.name else []
        budget = ["--budget"] if first.budget else []
        return shlex.join(["trihedron", "ablate", *(case.recording for case in self.cases), *first.swaps, *feedback, *budget, "out=again"])


def ablations_of(folders: Sequence[Path]) -> list[Ablation]:
    """Return the ablations in some folders. Raises DataError for a file that is no ablation."""
    found: list[Ablation] = []
    for folder in folders:
        groups: dict[tuple[str, ...], list[Case]] = {}
        try:
            for key, values in read_results(folder / RESULT).items():
                case = tables.case_from_dict(values)
                for variant, errors in zip(case.variants, read_errors(errors_file(folder, key), len(case.variants)) or ()):
                    variant.errors = errors
                groups.setdefault((case.feedback, *(variant.combination.label for variant in case.variants)), []).append(case)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise DataError(str(folder / RESULT), f"is not an ablation ({type(error).__name__})", "run trihedron ablate again") from error
        for (feedback, *_), cases in groups.items():
            count = f"{len(cases)} recordings" if len(cases) > 1 else f"one recording, {cases[0].frames} frames"
            slug = re.sub(r"[^a-z0-9]+", "-", folder.resolve().name.lower()).strip("-")
            title = f"{folder.resolve().name}: {count}, {LOOPS.get(feedback, feedback)}"
            found.append(Ablation(f"{len(found):03}-{slug}", title, tuple(cases)))
    return found


def ablation_page(ablation: Ablation, pictures: bool) -> str:
    """Return the page of an ablation as HTML."""
    cases = ablation.cases
    found = tables.verdicts(cases)
    against = [one for one in found if one.first == AS_RECORDED]
    sections = [tables.alternatives_table(cases), tables.attribution_table(cases), tables.cost_table(cases)]
    return render(
        "ablation.html",
        title=f"Ablation {ablation.title}",
        command=ablation.command,
        verdicts=tables.lines_of(against),
        others=[line_of(one, tables.FIGURES[one.figure]) for one in found if one.first != AS_RECORDED],
        note=NOTE,
        charts=charts_of(cases, against),
        tables=[{"title": one.title, "note": one.note, "header": one.rows[0], "rows": one.rows[1:]} for one in sections],
        attribution=attribution_bars(cases),
        curves=error_figures(cases),
        worst=worst_frames(cases, pictures),
    )


def charts_of(cases: Sequence[Case], against: Sequence[Verdict]) -> list[dict[str, Any]]:
    """Return a chart for each figure: its name, the ends of its scale, the place of "as recorded", and a row for each alternative with its label, its
    text, its dot and its interval, places in per cent of the width. The interval is that of the difference from "as recorded"."""
    verdicts = {(one.second, one.figure): one for one in against}
    return [_chart(name, by_change(cases), verdicts) for name in tables.columns_of(cases)]


def _chart(name: str, changes: dict[str, list[tuple[Case, Variant]]], verdicts: dict[tuple[str, str], Verdict]) -> dict[str, Any]:
    values = {label: np.array([variant.figures.get(name, np.nan) for _, variant in group]) for label, group in changes.items()}
    reference = tables.mean_of(values[AS_RECORDED])
    rows = [_difference(name, label, some, values[AS_RECORDED], verdicts.get((label, name))) for label, some in values.items()]
    ends = np.array([reference + offset for row in rows for offset in (row["difference"], row["low"], row["high"]) if offset is not None])
    ends = ends[np.isfinite(ends)] if np.isfinite(ends).any() else np.zeros(1)
    low, high = float(ends.min()), float(ends.max())
    equal = number(name, low) == number(name, high)  # to the digits shown

    def place(offset: float) -> float:
        return round(50.0 if equal else MARGIN + (100.0 - 2.0 * MARGIN) * (reference + offset - low) / (high - low), 2)

    for row in rows:
        row["dot"] = place(row["difference"]) if np.isfinite(row["difference"]) else None
        row["interval"] = (place(row["low"]), place(row["high"])) if row["low"] is not None else None
    scale = ("", "") if equal else (number(name, low), number(name, high))
    return {"name": name, "scale": scale, "reference": place(0.0) if np.isfinite(reference) else None, "rows": rows}


def _difference(name: str, label: str, values: Any, recorded: Any, verdict: Verdict | None) -> dict[str, Any]:
    """Return a row's label, text, difference from "as recorded" and the ends of its interval, None where there is none."""
    if label == AS_RECORDED:
        return {"label": label, "text": number(name, tables.mean_of(values)), "difference": 0.0, "low": None, "high": None}
    differences = values - recorded
    differences = differences[np.isfinite(differences)]
    difference, half = tables.mean_of(differences), half_interval(differences)
    low, high = (None, None) if half is None else (difference - half, difference + half)
    if verdict is not None:
        difference, low, high = verdict.difference, verdict.low, verdict.high
    interval = "no interval" if low is None else f"95 %: {number(name, low, True)} to {number(name, high, True)}"
    text = f"{number(name, tables.mean_of(values))}, {number(name, difference, True)} ({interval})"
    return {"label": label, "text": text, "difference": difference, "low": low, "high": high}


def attribution_bars(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Return for each figure the bars of the Shapley values of its swaps."""
    shares = [one for one in tables.attribution(cases) if one["figure"] in SHOWN and one["mean"] == one["mean"]]
    figures = []
    for name in dict.fromkeys(one["figure"] for one in shares):
        bars = [one for one in shares if one["figure"] == name]
        largest = max(abs(one["mean"]) for one in bars) or 1.0
        figures.append({"name": name, "bars": [_bar(name, one, largest) for one in bars]})
    return figures


def _bar(name: str, one: dict[str, Any], largest: float) -> dict[str, Any]:
    """A bar: its label and text, and its place in per cent of the width; zero is in the middle."""
    length = 50.0 * abs(one["mean"]) / largest
    half = "" if one["half"] is None else f" ± {number(name, one['half'])}"
    label = one["words"] if one["stage"] else f"together: {one['target']}"
    left = 50.0 if one["mean"] >= 0.0 else 50.0 - length
    return {"label": label, "text": number(name, one["mean"], True) + half, "left": round(left, 2), "length": round(max(length, 0.3), 2)}


def error_figures(cases: Sequence[Case]) -> dict[str, Any]:
    """Return the errors over time in the recording where an alternative is farthest from the recorded configuration: a figure for each measure that
    has errors of frames, the legend, and the recording."""
    case, _ = tables.farthest([(case, variant) for case in cases for variant in case.variants])
    shown = case.variants[:MOST_CURVES]
    known = {name for variant in shown for name, values in variant.errors.items() if np.isfinite(values).sum() > 1}
    names = [name for name, figure in tables.FIGURES.items() if name in known and figure.power == 2]
    figures: list[Figure] = []
    for name in names:
        curves = [variant.errors.get(name, np.full(case.frames, np.nan)) for variant in shown]
        title, _, unit = name.rpartition(" ")
        figures.append(curves_figure(title, unit, [(np.arange(len(values)) / case.fps, values) for values in curves]))
    legend = [(variant.combination.label, *look_of(k)) for k, variant in enumerate(shown)]
    more = len(case.variants) - len(shown)
    return {"figures": figures, "legend": legend, "recording": case.recording, "more": more}


def worst_frames(cases: Sequence[Case], pictures: bool) -> list[dict[str, Any]]:
    """Return for each alternative the frame where it is farthest from the recorded configuration: a sentence, and the picture of both."""
    found: list[dict[str, Any]] = []
    for label, group in by_change(cases).items():
        case, variant = tables.farthest(group)
        parting, picture = variant.parting, Path(variant.picture)
        if label == AS_RECORDED:
            continue
        if parting.frame is None or parting.worst is None:
            found.append({"text": f"{label}: equal to the recorded configuration in all frames"})
            continue
        apart = f", {parting.distance:.3g} {parting.unit} apart" if parting.unit else ""
        text = f"{label}: frame {parting.worst} of {case.recording}{apart}; {parting.frames} of {case.frames} frames differ"
        alt = f"Frame {parting.worst} as recorded, with {label}, and both paths from above"
        found.append({"text": text, "picture": embed_picture(picture, alt) if pictures and picture.is_file() else None})
    return found
