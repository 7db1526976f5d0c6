"""Attribution of ablations on the pages of results: a bar for the Shapley value of each swap, from the ablation.json of a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.run.result_files import read_results
from trihedron.tools.ablation_tables import Case, attribution, case_from_dict, number

FILE = "ablation.json"
SHOWN = ("ATE mm", "RPE 1 frame mm", "RPE 1 s mm", "axes deg", "rotation deg", "translation mm", "ms")


def ablations_of(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Return the ablations in some folders: title, and for each figure its bars. Raises DataError for a file that is no ablation."""
    found = []
    for folder in folders:
        groups: dict[tuple[str, ...], list[Case]] = {}
        try:
            for values in read_results(folder / FILE).values():
                case = case_from_dict(values)
                groups.setdefault(tuple(variant.combination.label for variant in case.variants), []).append(case)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise DataError(str(folder / FILE), f"is not an ablation ({type(error).__name__})", "run trihedron ablate again") from error
        for cases in groups.values():
            count = f"{len(cases)} recordings" if len(cases) > 1 else f"one recording, {cases[0].frames} frames"
            found.append({"title": f"{folder.name}: {count}", "figures": _figures(cases)})
    return found


def _figures(cases: Sequence[Case]) -> list[dict[str, Any]]:
    shares = [one for one in attribution(cases) if one["figure"] in SHOWN and one["mean"] == one["mean"]]
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
