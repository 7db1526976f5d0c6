"""Runs that are judged by the truth, and what they show of the honesty of status and covariances, as one table.

A figure of several runs is the mean of that of each run, with a 95 % interval by Student's t over the runs where there are at least three. NEES and
σ/error are ratios, whose mean is geometric. Wrong ok is a sum.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trihedron.pipeline.core.errors import UsageError, did_you_mean
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.sweep.paired_statistics import half_interval

if TYPE_CHECKING:
    from trihedron.pipeline.run.status_check import FrameErrors, StatusCheck

LEAST_RUNS = 3  # with an interval
WORDS = "words.json"  # in the folder of a run: the overrides that it was run with
FAULT = "fault"  # the group of cases that are not clean
SENSOR = "sensor"  # the group of simulated ones
Judged = tuple["StatusCheck", "FrameErrors"]
Row = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """A run to be judged: the name of its folder, its overrides, the groups it is in, kind -> name, of which each has a row (sensor, room, sequence
    or fault), and its seed."""

    name: str
    words: Sequence[str]
    groups: Mapping[str, str]
    seed: int = 0

    @property
    def clean(self) -> bool:
        """Return True where frames that are not ok are false alarms."""
        return FAULT not in self.groups


@dataclass(frozen=True)
class JudgedCase:
    """A case, and its run compared with the truth."""

    case: Case
    check: StatusCheck
    errors: FrameErrors


@dataclass(frozen=True)
class Figure:
    """A column of the table: its name in JSON and in the header, how it is written, and its limits."""

    name: str
    title: str
    value: Callable[[StatusCheck], float | None]
    factor: float = 1.0
    decimals: int = 1
    geometric: bool = field(default=False, kw_only=True)
    limits: tuple[float, float] = field(default=(-np.inf, np.inf), kw_only=True)

    def over(self, checks: Iterable[StatusCheck]) -> Row | None:
        """Return the mean over runs and its interval [low, high], None of too few runs; None where no run has the figure."""
        values = np.array([value for value in map(self.value, checks) if value is not None and not (self.geometric and value <= 0.0)])
        if not len(values):
            return None
        scaled = np.log(values) if self.geometric else values
        half = half_interval(scaled) if len(values) >= LEAST_RUNS else None
        mean = float(scaled.mean())
        ends = [mean] if half is None else [mean, mean - half, mean + half]
        mean, *interval = np.clip(np.exp(ends) if self.geometric else ends, *self.limits).tolist()
        return {"mean": mean, "interval": interval or None}

    def text(self, found: Row | None) -> str:
        """Write the mean and the interval."""
        if found is None:
            return "–"
        mean, *ends = (f"{self.factor * value:.{self.decimals}f}" for value in (found["mean"], *(found["interval"] or ())))
        return f"{mean} [{', '.join(ends)}]" if ends else mean


def share_of(count: float, check: StatusCheck) -> float:
    """Return a number of frames as a share of those of a run."""
    return count / max(check.frames, 1)


SHARE = (0.0, 1.0)
FIGURES = (
    Figure("ok_share", "ok %", lambda check: share_of(check.ok, check), 100.0, limits=SHARE),
    Figure("lost_share", "lost %", lambda check: share_of(check.lost, check), 100.0, limits=SHARE),
    Figure("ate_m", "ATE mm", lambda check: check.ate_m, 1e3, limits=(0.0, np.inf)),
    Figure("nees_median", "NEES", lambda check: check.nees_median, geometric=True),
    Figure("share_within_95", "in 95 %", lambda check: check.share_within_95, 100.0, 0, limits=SHARE),
    Figure("sigma_auc", "AUC", lambda check: check.sigma_auc, 1.0, 2, limits=SHARE),
    Figure("log_likelihood", "log-lik", lambda check: check.log_likelihood),
    Figure("spread_over_error", "σ/error", lambda check: check.spread_over_error, 1.0, 2, geometric=True),
)
HEADER = ["of", "name", "runs", "frames", "wrong ok", *(figure.title for figure in FIGURES)]


def judged_cases(cases: Iterable[Case], folder: Path) -> Iterator[JudgedCase]:
    """Run what is not in the folder yet, judge all, and print a line for each."""
    for case in cases:
        check, errors = run_and_judge(folder / case.name, case.words)
        print(f"{case.name}: {check.ok} of {check.frames} frames are ok, {check.wrong_ok} of them wrong", flush=True)
        yield JudgedCase(case, check, errors)


@contextmanager
def kept_or_temporary(runs: Path | None) -> Iterator[Path]:
    """Give the folder of --runs, or a temporary one."""
    with tempfile.TemporaryDirectory() as temporary:
        yield runs or Path(temporary)


def run_and_judge(run: Path, words: Sequence[str]) -> Judged:
    """Run, unless the folder holds a whole run with these overrides, and compare the poses with the truth."""
    from trihedron.tools.benchmark import measure

    kept = run / WORDS
    if not kept.exists() or json.loads(kept.read_text()) != list(words):
        kept.unlink(missing_ok=True)
        measure([*words, f"out={run}"], run)
        write_file(kept, json.dumps(list(words)) + "\n")
    return judged_run(run)


def judged_run(run: Path) -> Judged:
    """Compare the poses of a recorded run with the truth in it; without truth only their status is counted."""
    from trihedron.pipeline.app.recorded_values import poses_of, references_of
    from trihedron.pipeline.core.types import Trajectory
    from trihedron.pipeline.record.reader import Recording
    from trihedron.pipeline.record.trajectories import attached_truth
    from trihedron.pipeline.run.status_check import check_status

    recording = Recording(run / "run.mcap")
    truth = attached_truth(recording.attachments, str(recording.path))
    unknown = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    return check_status(poses_of(recording), truth if truth is not None else unknown, len(references_of(recording)))


def chosen(text: str, known: Iterable[str]) -> list[str]:
    """Split A,B. Raises UsageError for a name that is not known."""
    names = [name for name in text.split(",") if name]
    for name in names:
        if name not in known:
            raise UsageError("benchmark", f"there is no '{name}'", did_you_mean(name, list(known)))
    return names


def check_overrides(command: str, words: Iterable[str]) -> None:
    """Raise UsageError for a word that is no override."""
    for word in words:
        if "=" not in word:
            raise UsageError(command, f"'{word}' is not key=value", f"see trihedron {command} --help")


def rows_of(found: Sequence[JudgedCase]) -> list[Row]:
    """Return a row for each group in the order of the cases, faults last, and before them one for all clean runs: kind, name, runs, frames, wrong_ok
    (None without truth), the figures, and the frames that are not ok by the test."""
    kinds = dict.fromkeys(kind for one in found for kind in one.case.groups)
    groups = dict.fromkeys((kind, one.case.groups[kind]) for kind in kinds for one in found if kind in one.case.groups)
    rows = [_row(kind, name, [one.check for one in found if one.case.groups.get(kind) == name]) for kind, name in groups]
    clean = [one.check for one in found if one.case.clean]
    every = [_row("all", "clean runs", clean)] if clean else []
    return [*(row for row in rows if row["kind"] != FAULT), *every, *(row for row in rows if row["kind"] == FAULT)]


def _row(kind: str, name: str, checks: Sequence[StatusCheck]) -> Row:
    known = [check for check in checks if check.ate_m is not None]
    tests = dict.fromkeys(test for check in checks for test in check.not_ok)
    return {
        "kind": kind, "name": name, "runs": len(checks), "frames": sum(check.frames for check in checks),
        "wrong_ok": sum(check.wrong_ok for check in known) if known else None,
        **{figure.name: figure.over(checks) for figure in FIGURES},
        "not_ok": {test: sum(check.not_ok.get(test, 0) for check in checks) for test in tests},
    }  # fmt: skip


def alarms_of(found: Sequence[JudgedCase]) -> list[Row]:
    """Return the false alarms of each test, most first: its frames over all clean runs, and their share of a run's frames."""
    checks = [one.check for one in found if one.case.clean]
    rows = [
        {"test": test, "frames": sum(check.not_ok.get(test, 0) for check in checks), "share": alarm_figure(test).over(checks)}
        for test in dict.fromkeys(test for check in checks for test in check.not_ok)
    ]
    return sorted(rows, key=lambda row: -row["frames"])


def alarm_figure(test: str) -> Figure:
    """Return the share of frames that are not ok by a test."""
    return Figure(test, "share %", lambda check: share_of(check.not_ok.get(test, 0), check), 100.0, 2, limits=SHARE)


def rank_correlation(pairs: Iterable[tuple[float | None, float | None]]) -> tuple[float | None, int]:
    """Return Spearman's rank correlation of the pairs that are known, None of fewer than three or where one figure is always the same; and their
    number."""
    from scipy.stats import spearmanr

    known = np.array([pair for pair in pairs if None not in pair], float).reshape(-1, 2)
    known = known[np.isfinite(known).all(axis=1)]
    varies = len(known) >= LEAST_RUNS and np.ptp(known, axis=0).min() > 0.0
    return float(spearmanr(known[:, 0], known[:, 1])[0]) if varies else None, len(known)


def rank_by_sigma(found: Sequence[JudgedCase]) -> Row | None:
    """Return the rank correlation of the σ that runs of simulated sensors state, which needs no truth, with their ATE, and the number of these runs;
    None where there are too few."""
    rho, runs = rank_correlation((one.check.sigma_m, one.check.ate_m) for one in found if SENSOR in one.case.groups)
    return {"rank_correlation": rho, "runs": runs} if rho is not None else None


def rank_sentence(rank: Row) -> str:
    """Write what `rank_by_sigma` found."""
    return (
        f"The σ that a run states ranks {rank['runs']} runs of simulated sensors as their ATE does: rank correlation {rank['rank_correlation']:+.2f}."
    )


def cells_of(row: Row) -> list[str]:
    """Write a row as the cells of HEADER."""
    wrong = "–" if row["wrong_ok"] is None else str(row["wrong_ok"])
    return [row["kind"], row["name"], str(row["runs"]), str(row["frames"]), wrong, *(figure.text(row[figure.name]) for figure in FIGURES)]


def alarm_cells(row: Row) -> list[str]:
    """Write the false alarms of a test as cells: test, frames, share in percent."""
    return [row["test"], str(row["frames"]), alarm_figure(row["test"]).text(row["share"])]


def report(found: Sequence[JudgedCase]) -> str:
    """Make the table, that of false alarms by the test where there are any, and the sentence of `rank_by_sigma`."""
    parts = [table([HEADER, *map(cells_of, rows_of(found))], "ll" + "r" * (len(HEADER) - 2))]
    if alarms := [alarm_cells(row) for row in alarms_of(found)]:
        parts.append(table([["false alarms, by the test", "frames", "share %"], *alarms], "lrr"))
    if rank := rank_by_sigma(found):
        parts.append(rank_sentence(rank))
    return "\n\n".join(parts)


def plain(one: JudgedCase) -> Row:
    """Turn the figures of a run into what JSON holds."""
    return {"run": one.case.name, **one.case.groups, "seed": one.case.seed, **one.check.to_dict()}
