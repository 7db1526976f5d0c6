"""The verdicts and tables of an ablation: comparisons, attribution, differences and cost, from the figures of each recording; as text, markdown and
JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from trihedron.comparison.attribution import shapley_weights
from trihedron.comparison.block_bootstrap import bootstrap_blocks
from trihedron.comparison.fold_measures import COLUMNS as OF_FOLDS
from trihedron.comparison.partings import OPEN_LOOP, Parting
from trihedron.comparison.stage_measures import COLUMNS as MEASURED
from trihedron.comparison.swaps import AS_RECORDED, Combination
from trihedron.comparison.verdicts import NOTE, VERDICTS, Column, Sample, Verdict, line_of, verdicts_of
from trihedron.pipeline.core.config import Feedback
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import F64
from trihedron.pipeline.sweep.paired_statistics import CONFIDENCE, half_interval, half_width

RESULT = "ablation.json"
NEES = "NEES"
FIGURES = {  # in the order of columns
    "ATE mm": Column(2),
    "RPE 1 frame mm": Column(2),
    "RPE 1 s mm": Column(2),
    "RPE 1 s deg": Column(3),
    "ok %": Column(1, more=True, power=1),
    NEES: Column(2, power=0),
    "axes deg": Column(3),
    "rotation deg": Column(3),
    "translation mm": Column(2),
    "false axes %": Column(1, power=0),
    **{name: Column(1 if name.endswith("%") else 2) for name in MEASURED},
    **{name: Column(decimals, power=0) for name, decimals in OF_FOLDS.items()},
    "values %": Column(1, more=True, power=0),
    "ms": Column(2, power=1),
}


UNKNOWN_TRUTH = "there is no ground truth: single stages are measured by the poses of the recorded run, which is agreement with it and no error"


@dataclass
class Variant:
    """An alternative of one recording: its folder, figures by column (NaN: none), CPU seconds as in `Outcome`, and where it leaves the recorded
    configuration."""

    combination: Combination
    folder: str
    figures: dict[str, float]
    stages_s: float
    total_s: float
    rest_s: float = 0.0
    parting: Parting = field(default_factory=Parting)
    picture: str = ""
    errors: dict[str, F64] = field(default_factory=dict, compare=False, repr=False)  # of each frame (n,), by column, NaN where there is none


@dataclass
class Case:
    """All alternatives of one recording; the first is as recorded. `stages` are computed again, `shared` computed once because they are not recorded,
    `full_s` is the CPU time of the recorded run (NaN: not known), `budget` the errors with the truth in the place of stages, by their names."""

    recording: str
    frames: int
    stages: list[str]
    shared: list[str]
    full_s: float
    cpu_s: float
    variants: list[Variant]
    changed: str = ""  # what the recorded configuration computes now and the recording does not hold
    budget: dict[str, dict[str, float]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)  # sentences on rows of the budget that mean nothing
    fps: float = 30.0
    swaps: list[str] = field(default_factory=list)  # the words that the alternatives were made of
    feedback: str = Feedback.new.name
    recorded: str = ""  # size and time of the recording
    true: bool = True  # the poses by which single stages are measured are the ground truth, not those of the recorded run


@dataclass(frozen=True)
class Section:
    """A table with a title and a note; `right` as of `table`."""

    title: str
    rows: list[list[str]]
    right: str
    note: str = ""


def verdicts(cases: Sequence[Case]) -> list[Verdict]:
    """Return the verdict of each pair of alternatives, the earlier one first, in each figure; in the open loop of those that differ in one stage."""
    groups = by_change(cases)
    samples = {label: [_sample(case, variant) for case, variant in found] for label, found in groups.items()}
    stages = {label: found[0][1].combination.stages for label, found in groups.items()}
    compared = list(combinations(samples, 2))
    if cases[0].feedback == Feedback.recorded.name:
        compared = [(first, second) for first, second in compared if len(stages[first] | stages[second]) == 1]
    pairs = {(first, second): list(zip(samples[first], samples[second])) for first, second in compared}
    return verdicts_of(pairs, {name: column for name, column in FIGURES.items() if name != NEES})  # of which neither more nor less is better


def _sample(case: Case, variant: Variant) -> Sample:
    return Sample(variant.figures, variant.errors, round(case.fps))


def lines_of(found: Sequence[Verdict]) -> list[str]:
    """Return verdicts as lines."""
    return [line_of(one, FIGURES[one.figure]) for one in found]


def sections_of(cases: Sequence[Case]) -> list[Section]:
    """Return all tables of an ablation."""
    parts = [alternatives_table(cases), attribution_table(cases), parting_table(cases), cost_table(cases)]
    return [section for section in parts if len(section.rows) > 1]


def as_text(lines: Sequence[str], sections: Sequence[Section]) -> str:
    """Return the lines of the verdicts, then the tables, as aligned text."""
    parts = [f"{section.title}\n{table(section.rows, section.right)}" + (f"\n{section.note}" if section.note else "") for section in sections]
    return "\n\n".join(["\n".join([VERDICTS, *lines, NOTE]), *parts])


def as_markdown(lines: Sequence[str], sections: Sequence[Section]) -> str:
    """Return the verdicts, then the tables, as Markdown."""
    text = [f"## {VERDICTS}", "", *(f"- {line}" for line in lines), "", NOTE, ""]
    for section in sections:
        head, *rows = [[cell.replace("|", "\\|") for cell in row] for row in section.rows]
        rule = ["--:" if section.right[i : i + 1] == "r" else "---" for i in range(len(head))]
        text += [f"## {section.title}", "", *(f"| {' | '.join(row)} |" for row in (head, rule, *rows)), ""]
        text += [section.note, ""] if section.note else []
    return "\n".join(text)


def as_json(cases: Sequence[Case], found: Sequence[Verdict], sections: Sequence[Section]) -> dict[str, Any]:
    """Return cases, verdicts and tables, ready for JSON; a figure that does not exist is None."""
    tables = {section.title: [dict(zip(section.rows[0], row)) for row in section.rows[1:]] for section in sections}
    values: dict[str, Any] = _without_nan(
        {
            "verdicts": [{"text": line, **asdict(one)} for line, one in zip(lines_of(found), found)],
            "recordings": [case_to_dict(case) for case in cases],
            "attribution": attribution(cases),
            "tables": tables,
        }
    )
    return values


def case_to_dict(case: Case) -> dict[str, Any]:
    """Return the fields of a case, ready for JSON."""
    values = asdict(case)
    for one, variant in zip(values["variants"], case.variants):
        del one["errors"]  # they are in a file beside
        one["change"], one["combination"] = variant.combination.label, [[stage, list(words)] for stage, words in variant.combination.levels]
    found: dict[str, Any] = _without_nan(values)
    return found


def case_from_dict(values: Mapping[str, Any]) -> Case:
    """Return the case of which `case_to_dict` made this."""
    variants = []
    for one in values["variants"]:
        given = {key: value for key, value in one.items() if key != "change"}
        given["combination"] = Combination(tuple((stage, tuple(words)) for stage, words in one["combination"]))
        given["figures"] = {name: np.nan if value is None else value for name, value in one["figures"].items()}
        variants.append(Variant(**{**given, "parting": Parting(**one["parting"])}))
    full_s = np.nan if values["full_s"] is None else values["full_s"]
    budget = {name: {key: np.nan if value is None else value for key, value in row.items()} for name, row in values["budget"].items()}
    return Case(**{**values, "variants": variants, "full_s": full_s, "budget": budget})


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def columns_of(cases: Sequence[Case]) -> list[str]:
    """Return the figures that at least one alternative has."""
    return [name for name in FIGURES if any(np.isfinite(variant.figures.get(name, np.nan)) for case in cases for variant in case.variants)]


def number(name: str, value: float | None, sign: bool = False) -> str:
    """Return a figure as text, "-" where there is none."""
    if value is None or not np.isfinite(value):
        return "-"
    text = f"{value:{'+' if sign else ''}.{FIGURES[name].decimals}f}"
    return text if float(text) else text.lstrip("+-")


def by_change(cases: Sequence[Case]) -> dict[str, list[tuple[Case, Variant]]]:
    """Return the alternatives of all recordings by their words, as recorded first."""
    found: dict[str, list[tuple[Case, Variant]]] = {}
    for case in cases:
        for variant in case.variants:
            found.setdefault(variant.combination.label, []).append((case, variant))
    return found


def alternatives_table(cases: Sequence[Case]) -> Section:
    """Means over the recordings of every figure of every alternative."""
    columns = columns_of(cases)
    rows = [["change", *columns]]
    for label, found in by_change(cases).items():
        values = {name: [variant.figures.get(name, np.nan) for _, variant in found] for name in columns}
        rows.append([label, *(number(name, mean_of(some)) for name, some in values.items())])
    count = f"mean of {len(cases)} recordings" if len(cases) > 1 else f"{cases[0].recording}, {cases[0].frames} frames"
    note = f"computed again: {', '.join(cases[0].stages)}; ms are CPU milliseconds a frame of these"
    if not all(case.true for case in cases) and any(name in columns for name in OPEN_LOOP):
        note += f"\n{UNKNOWN_TRUTH}"
    return Section(f"Alternatives, {count}", rows, "l" + "r" * len(columns), note)


def mean_of(values: Iterable[float]) -> float:
    """Return the mean of the values that are finite, NaN where there is none."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else np.nan


def targets_of(case: Case) -> list[Combination]:
    """Return the combinations in which most stages are swapped."""
    most = max(len(variant.combination.stages) for variant in case.variants)
    return [variant.combination for variant in case.variants if len(variant.combination.stages) == most]


def attribution(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Return for each combination of swaps, stage and figure the Shapley value: its mean over the recordings and half its confidence interval, of
    one recording from its frames (None where there is none). The stage "" is their sum, the whole difference, where there are several."""
    found = []
    for target in targets_of(cases[0]):
        variants = [{variant.combination: variant for variant in case.variants} for case in cases]
        whole = {"": {frozenset(): -1.0, target.stages: 1.0}} if len(target.stages) > 1 else {}
        weights = {**shapley_weights(target.stages), **whole}
        for name in columns_of(cases):
            for stage, of_parts in weights.items():
                parts = [[one[target.part(part)] for part in of_parts] for one in variants]
                values = [sum(w * variant.figures.get(name, np.nan) for w, variant in zip(of_parts.values(), some)) for some in parts]
                finite = np.array([value for value in values if np.isfinite(value)])
                half = half_interval(finite) if len(cases) > 1 else _half_of_frames(cases[0], name, parts[0], list(of_parts.values()))
                words = " ".join(dict(target.levels).get(stage, target.words))
                mean = float(finite.mean()) if len(finite) else np.nan
                found.append({"target": target.label, "stage": stage, "words": words, "figure": name, "mean": mean, "half": half})
    return found


def _half_of_frames(case: Case, name: str, variants: Sequence[Variant], weights: Sequence[float]) -> float | None:
    """Half the confidence interval of a weighted sum of a figure, from the frames of one recording; None where there are none, or too few."""
    errors = [variant.errors.get(name, np.full(case.frames, np.nan)) for variant in variants]
    if not FIGURES[name].power or not np.isfinite(errors).all(axis=0).any():
        return None
    found = bootstrap_blocks(errors, weights, max(1, round(case.fps)), FIGURES[name].power)
    return None if found.error is None else half_width(found.error, found.blocks - 1)


def attribution_table(cases: Sequence[Case]) -> Section:
    """Shapley values of the swapped stages; of one recording the error budget too."""
    columns, rows = columns_of(cases), []
    by_row: dict[tuple[str, str], dict[str, str]] = {}
    for one in attribution(cases):
        half = "" if one["half"] is None else f" ± {number(one['figure'], one['half'])}"
        text = one["words"].replace("+", "") if one["stage"] else "all of them"
        by_row.setdefault((one["target"], text), {})[one["figure"]] = number(one["figure"], one["mean"], True) + half
    targets = {target for target, _ in by_row}
    for (target, text), cells in by_row.items():
        if text == "all of them" and len(targets) > 1:
            text = f"all of {target}"
        rows.append([text, *(cells.get(name, "-") for name in columns)])
    budget = cases[0].budget if len(cases) == 1 else {}
    for stages, figures in budget.items():
        whole = budget.get("", {})
        if stages:
            rows.append([f"truth in the place of {stages}", *(number(n, figures.get(n, np.nan) - whole.get(n, np.nan), True) for n in columns)])
    over = f"over {len(cases)} recordings" if len(cases) > 1 else "from the frames of one recording, where a figure is a mean over frames"
    interval = f"± half the {100 * CONFIDENCE:.0f} % interval {over}"
    note = "\n".join([f"Differences; {interval}", *(f"Truth: {sentence}" for case in cases if len(cases) == 1 for sentence in case.remarks)])
    return Section("Attribution: Shapley value of each swap", [["swap", *columns], *rows], "l" + "r" * len(columns), note)


def parting_table(cases: Sequence[Case]) -> Section:
    """List where each alternative leaves the recorded configuration; of several recordings the one in which they are farthest apart."""
    rows = [["change", "recording", "first frame", "first difference", "frames", "worst frame", "apart there", "picture"]]
    for label, group in by_change(cases).items():
        if label == AS_RECORDED:
            continue
        case, variant = farthest(group)
        parting = variant.parting
        if parting.frame is None:
            rows.append([label, case.recording, "-", "none: equal in all frames", "0", "-", "-", ""])
            continue
        what = f"{parting.topic}.{parting.field}: {parting.size}"
        apart = f"{parting.distance:.3g} {parting.unit}" if parting.unit else "-"
        counts = [f"{parting.frames} of {case.frames}", str(parting.worst)]
        rows.append([label, case.recording, str(parting.frame), what, *counts, apart, variant.picture])
    return Section("Where they differ", rows, "llrlrrrl")


def farthest(group: Sequence[tuple[Case, Variant]]) -> tuple[Case, Variant]:
    """Return the recording in which an alternative is farthest from the recorded configuration."""
    return max(group, key=lambda one: (one[1].parting.distance, one[1].parting.frames))


def cost_table(cases: Sequence[Case]) -> Section:
    """CPU time of each alternative, over all recordings."""
    rows = [["change", "stages alone s", "cost s", "of it no stage s", "× its stages", "full run s", "× less"]]
    for label, group in by_change(cases).items():
        stages, total, rest = (sum(getattr(variant, name) for _, variant in group) for name in ("stages_s", "total_s", "rest_s"))
        full = sum(case.full_s + 1e-3 * case.frames * (variant.figures["ms"] - case.variants[0].figures["ms"]) for case, variant in group)
        known = np.isfinite(full) and total > 0.0
        ratio = f"{total / stages:.2f}" if stages > 0.0 else "-"
        against = [f"{full:.2f}", f"{full / total:.1f}"] if known else ["-", "-"]
        rows.append([label, f"{stages:.2f}", f"{total:.2f}", f"{rest:.2f}", ratio, *against])
    shared = sorted({name for case in cases for name in case.shared})
    note = (
        "CPU seconds; a cost has a share of each stage that serves several alternatives; no stage are reading, recording, scheduling, measures and "
        "results; the full run with a swap is the recorded one, with the stages that the swap changes"
    )
    return Section("Cost", rows, "lrrrrrr", note + (f"; not recorded, so computed once for all: {', '.join(shared)}" if shared else ""))
