"""The runs of sweeps, and single runs, as rows of one table: what each one changed, and the median of each figure."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison import other_programs
from trihedron.comparison.run_samples import COLUMNS, paired_samples
from trihedron.comparison.run_tables import FIGURES
from trihedron.comparison.verdicts import Sample, Verdict, line_of, verdicts_of
from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean, printable
from trihedron.pipeline.run.result_files import read_results, read_words
from trihedron.pipeline.sweep.jobs import SEEDS
from trihedron.pipeline.sweep.paired_statistics import half_interval
from trihedron.plugins.surface.files import SURFACE, SURFACE_ERRORS

ALL_DATA = "all"  # in the place of a data set: differences over all of them
NOT_SHOWN = ("out", "report", "experiment", "sequences", "alternatives", *SEEDS)
OVERRIDES = Path(".hydra") / "overrides.yaml"


@dataclass(frozen=True)
class Run:
    """One run: its folder, its overrides (key -> value), its figures by column, NaN where there is none, and why, if there is a reason."""

    folder: Path
    overrides: dict[str, str]
    figures: dict[str, float]
    note: str = ""
    label: str = ""  # of another program's trajectory, in the place of its changes

    @property
    def seeds(self) -> tuple[str, ...]:
        """Seeds, which make it a repeat of another run, and pair it with one of the baseline."""
        return tuple(self.overrides.get(key, "") for key in SEEDS)


def run_folders(folder: Path) -> list[Path]:
    """The run folders in a folder, itself or else the jobs of a sweep, by job number. Raises DataError when it holds none, or does not
    exist."""
    if not folder.exists():
        cause = "does not exist" if folder.is_absolute() else f"does not exist in {Path.cwd()}"
        raise DataError(str(folder), cause, "give the out=FOLDER of a run or of a sweep")
    files = [*folder.glob(".hydra/overrides.yaml")] or [*folder.glob("*/.hydra/overrides.yaml")]
    if not files:
        raise DataError(str(folder), "holds no runs", "give the out=FOLDER of a sweep, for example of: trihedron run -m experiment=leave_one_out")
    return [file.parent.parent for file in sorted(files, key=lambda f: (len(str(f)), str(f)))]


def read_runs(*folders: Path) -> list[Run]:
    """The runs in folders; one whose files cannot be read is reported and left out. Raises DataError for a folder without runs, and where none is
    left."""
    runs, refused = [], []
    for folder in [run for given in folders for run in run_folders(given)]:
        try:
            runs.append(_run(folder))
        except DataError as error:
            refused.append(error)
    if not runs:
        raise refused[0]
    for one in refused:
        print(f"trihedron: warning: {DataError(one.place, one.cause, 'this run is left out')}", file=sys.stderr)
    return runs


def read_trajectories(files: Sequence[Path], runs: Sequence[Run], labels: Sequence[str] = (), y_up: bool = False) -> list[Run]:
    """Return trajectories of other programs as runs of the data that `runs` have. Raises DataError for one of none or of several of them."""
    candidates = other_programs.references([(run.folder, run.overrides) for run in runs]) if files else []
    if labels and not files:
        raise UsageError("--label", "there is no trajectory", "give files of other programs behind the folders")
    found = []
    for number, file in enumerate(files):
        label = other_programs.label_of(file, labels, number, len(files))
        reference, final = other_programs.judge(file, candidates, y_up)
        found.append(Run(file, reference.overrides, _figures_in_units({"final": final}, {}, {}), label=label))
    return found


def _run(folder: Path) -> Run:
    overrides = dict(printable(word).lstrip("+~").partition("=")[::2] for word in read_words(folder / OVERRIDES))
    metrics, timing, job = (read_results(folder / name) for name in ("metrics.json", "timing.json", "job.json"))
    if job.get("state", "done") != "done":
        return Run(folder, overrides, dict.fromkeys(FIGURES, np.nan), str(job.get("error") or "was stopped before its end"))
    figures = _figures_in_units(metrics, timing, read_results(folder / SURFACE_ERRORS))
    return Run(folder, overrides, figures, str(metrics.get("note", "")) if metrics or timing else "holds no results")


def _figures_in_units(metrics: dict[str, Any], timing: dict[str, Any], surface: dict[str, Any]) -> dict[str, float]:
    """Return every column's value in the column's unit, NaN where there is none."""
    known = _values_by_column(metrics, timing, surface)
    return {name: np.nan if known.get(name) is None else figure.factor * float(known[name]) for name, figure in FIGURES.items()}


def _values_by_column(metrics: dict[str, Any], timing: dict[str, Any], surface: dict[str, Any]) -> dict[str, Any]:
    """Every figure a run's files have, by column, in SI units; too short a run has no RPE over a second, and few have a surface."""
    final, frame, mesh = metrics.get("final") or {}, timing.get("frame_ms") or {}, (surface.get("parts") or {}).get("all") or {}
    status = metrics.get("status") or {}
    tracked = sum(status.get(name) or 0 for name in ("ok", "degraded")) / metrics["frames"] if status and metrics.get("frames") else None
    return {
        "tracked %": final.get("tracked_share", tracked),
        "ATE mm": final.get("ate_rmse_m"),
        "RPE 1 s mm": final.get("rpe_second_rmse_m"),
        "RPE 1 s deg": final.get("rpe_second_rmse_deg"),
        "end to start mm": None if final else metrics.get("start_to_end_m"),
        "surface mm": mesh.get("mean_m"),
        "within 5 cm %": mesh.get("within_5_cm"),
        "p50 ms": frame.get("p50"),
        "p95 ms": frame.get("p95"),
        "memory MB": timing.get("own_memory_mb"),
    }


def judge_surfaces(folders: Sequence[Path]) -> None:
    """Write surface.json beside each surface.ply that has none; one that cannot be judged is skipped, and each reason printed once."""
    from trihedron.comparison.fold_measures import judge_surface

    reasons = set()
    for folder in (run for given in folders for run in run_folders(given)):
        if (folder / SURFACE).exists() and not (folder / SURFACE_ERRORS).exists():
            try:
                judge_surface(folder, folder / "run.mcap")
            except DataError as error:
                if str(error) not in reasons:
                    print(f"{folder / SURFACE} is not judged: {error}")
                reasons.add(str(error))


def groups_of(runs: Sequence[Run]) -> dict[tuple[str, str], list[Run]]:
    """Return the runs of each row, by data and change: runs that differ in their seeds alone share one, data sets stand together."""
    keys = {key for run in runs for key in run.overrides if key not in NOT_SHOWN}
    own = [run for run in runs if not run.label]
    varying = sorted(key for key in keys if len({run.overrides.get(key) for run in own}) > 1)
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        change = run.label or _override_text(run, [k for k in varying if not is_of_data(k)])
        groups.setdefault((_override_text(run, [k for k in varying if is_of_data(k)]), change), []).append(run)
    order = list(dict.fromkeys(data for data, _ in groups))
    return dict(sorted(groups.items(), key=lambda group: order.index(group[0][0])))


def rows_of(runs: Sequence[Run], baseline: str = "") -> list[dict[str, Any]]:
    """One row for each data set and change: `data`, `change`, `runs`, `note`, of each figure's runs median, smallest and largest, and with a baseline
    the paired `difference` of each figure. Then, if there are several data sets, the differences over all of them, `data` = "all". `verdicts` are
    empty: see `with_verdicts`."""
    groups = groups_of(runs)
    order = list(dict.fromkeys(data for data, _ in groups))
    _check_baseline(baseline, [change for _, change in groups])
    rows = [row_of(data, change, same, groups.get((data, baseline)) if change != baseline else None) for (data, change), same in groups.items()]
    if baseline and len(order) > 1:
        for other in dict.fromkeys(change for _, change in groups if change != baseline):
            pairs = [pair for data in order for pair in _pairs(groups.get((data, other), []), groups.get((data, baseline), []))]
            figures = {"figures": {}, "note": "", "difference": _differences(pairs), "verdicts": {}}
            rows.append({"data": ALL_DATA, "change": other, "runs": len(pairs), **figures})
    return rows


def row_of(data: str, change: str, same: Sequence[Run], base: Sequence[Run] | None = None) -> dict[str, Any]:
    """Return the row of runs that share one, and their paired differences from those of the baseline. `half` of a figure is half the 95 % interval of
    its mean, None for one run."""
    figures = {}
    for name in FIGURES:
        values = [run.figures[name] for run in same if np.isfinite(run.figures[name])]
        if values:
            figures[name] = {**spread_of(values), "mean": float(np.mean(values)), "half": half_interval(values)}
    notes = dict.fromkeys(run.note for run in same if run.note)
    return {
        "data": data,
        "change": change,
        "runs": len(same),
        "figures": figures,
        "note": "; ".join(notes),
        "difference": _differences(_pairs(same, base or [])),
        "verdicts": {},
    }


def spread_of(values: Sequence[float]) -> dict[str, Any]:
    """Return median, smallest and largest of the values of some runs, and their number."""
    return {"median": float(np.median(values)), "min": min(values), "max": max(values), "runs": len(values)}


def verdicts_against(runs: Sequence[Run], baseline: str) -> list[Verdict]:
    """Return the verdict of each change against the baseline in each figure, over all data and seeds that both have; none without a baseline."""
    groups = groups_of(runs) if baseline else {}
    pairs: dict[tuple[str, str], list[tuple[Sample, Sample]]] = {}
    for (data, change), same in groups.items():
        if change != baseline:
            pairs.setdefault((baseline, change or "-"), []).extend(samples_of(same, groups.get((data, baseline), [])))
    return verdicts_of(pairs, COLUMNS)


def samples_of(runs: Sequence[Run], base: Sequence[Run]) -> list[tuple[Sample, Sample]]:
    """Return the samples of the runs of one row that have the seeds of a run of the baseline's row, that run's first."""
    return [paired_samples(other.folder, run.folder, (other.figures, run.figures)) for run, other in _pairs(runs, base)]


def with_verdicts(rows: Sequence[dict[str, Any]], found: Sequence[Verdict]) -> list[dict[str, Any]]:
    """Return the rows with `verdicts`, by figure, of the change of each over all data: in the row of all data where there is one."""
    over_all = any(row["data"] == ALL_DATA for row in rows)
    by_change: dict[str, dict[str, Any]] = {}
    for one in found:
        by_change.setdefault(one.second, {})[one.figure] = {"text": line_of(one, COLUMNS[one.figure]), **asdict(one)}
    return [{**row, "verdicts": by_change.get(row["change"] or "-", {})} if not over_all or row["data"] == ALL_DATA else row for row in rows]


def _pairs(runs: Sequence[Run], base: Sequence[Run]) -> list[tuple[Run, Run]]:
    """Runs with those of the baseline that have the same seeds."""
    by_seeds = {run.seeds: run for run in base if not run.label}
    return [(run, by_seeds[run.seeds]) for run in runs if not run.label and run.seeds in by_seeds]


def _differences(pairs: Sequence[tuple[Run, Run]]) -> dict[str, dict[str, Any]]:
    """Column -> mean difference, the ends of its confidence interval (None for a single pair) and the number of pairs."""
    out = {}
    for name in FIGURES:
        differences = np.array([run.figures[name] - base.figures[name] for run, base in pairs])
        differences = differences[np.isfinite(differences)]
        if len(differences):
            mean, half = float(differences.mean()), half_interval(differences)
            low, high = (None, None) if half is None else (mean - half, mean + half)
            out[name] = {"mean": mean, "low": low, "high": high, "pairs": len(differences)}
    return out


def _check_baseline(baseline: str, changes: Sequence[str]) -> None:
    if baseline and baseline not in changes:
        raise UsageError("--baseline", f"no row is '{baseline}'", did_you_mean(baseline, {change for change in changes if change}))


def is_of_data(key: str) -> bool:
    """Return True for the key of an option of the data set."""
    return key.partition(".")[0] == "dataset"


def shown_words(run: Run) -> dict[str, str]:
    """Return the overrides that tell a run's row from others, by key; of a path its last part."""
    return {key: Path(value).name for key, value in run.overrides.items() if key not in NOT_SHOWN and value != "null"}


def _override_text(run: Run, keys: Sequence[str]) -> str:
    """Overrides of a run for these keys."""
    words = shown_words(run)
    return " ".join(f"{key}={words[key]}" for key in keys if key in words)
