"""Progress of a sweep on standard error, as its jobs end in other processes or on other machines: on a terminal a live table, else a line each."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.run.results import METRICS, TIMING
from trihedron.pipeline.sweep.jobs import DONE, FAILED, RUNNING, SEEDS, Job, read_job
from trihedron.pipeline.sweep.paired_statistics import half_interval

LOOK_SECONDS = 1.0  # between two looks at the jobs' folders
ROWS = 12  # of the live table, at most
UP, CLEAR = "\x1b[{}F", "\x1b[J"  # to the beginning of the line so many above; to the end of the screen


@dataclass
class Watched:
    """A job: its folder, what it changes, its last state, when it was first seen to run and to have ended (perf_counter), and then the metrics and
    the number of frames."""

    folder: Path
    change: str
    job: Job
    began: float | None = None
    ended: float | None = None
    metrics: dict[str, Any] = field(default_factory=dict)
    frames: int | None = None

    @property
    def over(self) -> bool:
        """True if the job has ended."""
        return self.ended is not None

    @property
    def ate_mm(self) -> float | None:
        """The absolute trajectory error, where there is one."""
        found = (self.metrics.get("final") or {}).get("ate_rmse_m")
        return None if found is None else 1e3 * float(found)

    @property
    def words_without_seeds(self) -> str:
        """The words but for seeds, which all repeats have."""
        return " ".join(word for word in self.change.split(" ") if word.lstrip("+").partition("=")[0] not in SEEDS)

    def end(self, now: float) -> None:
        """Read the results of the job, which has ended."""
        self.ended = now
        with suppress(DataError):
            self.metrics, self.frames = read_results(self.folder / METRICS), read_results(self.folder / TIMING).get("frames")


class Progress:
    """A context that counts the jobs which are done, reports which failed and why, and about how long the rest will take."""

    def __init__(self, folders: Sequence[Path], changes: Sequence[str], before: int, total: int, failed: int = 0) -> None:
        """`before` jobs of `total` are done and `failed` are refused; those of `folders`, which change what `changes` say, are done or will be."""
        self._jobs = [Watched(folder, change, read_job(folder)) for folder, change in zip(folders, changes)]
        self._before, self._total, self._failed = before, total, failed
        self._began, self._stop = time.perf_counter(), threading.Event()
        for watched in (job for job in self._jobs if job.job.get("state") == DONE):
            watched.end(self._began)
        self._stream, self._drawn = sys.stderr, 0  # which a job in this process redirects
        self._live = self._stream.isatty()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *exception: object) -> None:
        self._stop.set()
        self._thread.join()
        self._look()

    def _watch(self) -> None:
        while not self._stop.wait(LOOK_SECONDS):
            self._look()

    def _look(self) -> None:
        now = time.perf_counter()
        ended = []
        for watched in (job for job in self._jobs if not job.over):
            watched.job = read_job(watched.folder)
            state = watched.job.get("state")
            watched.began = now if watched.began is None and state is not None else watched.began
            if state in (DONE, FAILED):
                watched.end(now)
                ended.append(watched)
        if self._live:
            self._draw(ended, now)
            return
        for watched in ended:
            if watched.job["error"]:
                print(reason(watched.folder, watched.job["error"]), file=self._stream)
        if ended:
            print(self._summary(now), file=self._stream)

    def _summary(self, now: float) -> str:
        over, seconds = [job for job in self._jobs if job.over], now - self._began
        failed = sum(job.job.get("state") == FAILED for job in over)
        done, here = self._before + len(over) - failed, sum(job.began is not None for job in over)
        left = self._total - done - failed - self._failed
        counts = [f"{done} of {self._total} jobs done", *([f"{failed + self._failed} failed"] if failed + self._failed else [])]
        counts += [f"{left} left"] if left else []
        ahead = f", about {duration(seconds / here * (len(self._jobs) - len(over)))} left" if here else ""
        return f"sweep: {', '.join(counts)}, {duration(seconds)}{ahead}"

    def _draw(self, ended: Sequence[Watched], now: float) -> None:
        """Redraw the table in its place; the reason of a failure stays above it."""
        width = shutil.get_terminal_size().columns - 1
        above = [reason(watched.folder, watched.job["error"]) for watched in ended if watched.job["error"]]
        repeats = self.repeats()[: ROWS // 2]
        lines = [line[:width] for line in [self._summary(now), *self.rows(now, ROWS - len(repeats)), *repeats]]
        up = UP.format(self._drawn) + CLEAR if self._drawn else ""
        print(up + "".join(f"{line}\n" for line in [*above, *lines]), end="", file=self._stream, flush=True)
        self._drawn = len(lines)

    def rows(self, now: float, most: int = ROWS) -> list[str]:
        """Return the rows of the table: the jobs that run, then those that ended last, at most so many."""
        running = [job for job in self._jobs if not job.over and job.job.get("state") == RUNNING]
        last = sorted((job for job in self._jobs if job.over and job.began is not None), key=lambda job: -(job.ended or 0.0))
        shown = [*running, *last][:most]
        spent = [duration((job.ended or now) - (job.began or now)) for job in shown]
        cells = [(job.folder.name, str(job.job.get("state", "")), took, _result(job), job.change) for job, took in zip(shown, spent)]
        widths = [max((len(row[column]) for row in cells), default=0) for column in range(4)]
        return ["  ".join(["", *(cell.rjust(width) for cell, width in zip(row, widths)), printable(row[4])]) for row in cells]

    def repeats(self) -> list[str]:
        """Return a row for each change of which several seeds are done: the median of their ATE, and the mean with its 95 % interval."""
        groups: dict[str, list[float]] = {}
        for job in self._jobs:
            if job.ate_mm is not None:
                groups.setdefault(job.words_without_seeds, []).append(job.ate_mm)
        return [f"  {repeats_text(values)}  {printable(change)}".rstrip() for change, values in groups.items() if len(values) > 1]


def _result(job: Watched) -> str:
    """The error of a job that is done, else the number of its frames."""
    if job.job.get("state") != DONE:
        return ""
    return f"ATE {job.ate_mm:.2f} mm" if job.ate_mm is not None else f"{job.frames} frames" if job.frames else ""


def reason(folder: Path, error: object) -> str:
    """Return the line with the reason why the job of a folder failed."""
    return f"trihedron: job {folder.name}: {error}"


def repeats_text(values: Sequence[float]) -> str:
    """Return the errors of several repeats (at least two) as text."""
    half = half_interval(values)
    return f"{len(values)} seeds: ATE median {np.median(values):.2f} mm, mean {np.mean(values):.2f} ± {half:.2f} (95 %)"


def duration(seconds: float) -> str:
    """Return a time as text of two or three digits."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
