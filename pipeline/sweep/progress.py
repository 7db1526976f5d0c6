"""Progress of a sweep on standard error, as its jobs end in other processes or on other machines: on a terminal a live table, else a line each."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.run.results import METRICS, TIMING
from trihedron.pipeline.sweep.jobs import DONE, FAILED, RUNNING, Job, read_job

LOOK_SECONDS = 1.0  # between two looks at the jobs' folders
ROWS = 12  # of the live table, at most
UP, CLEAR = "\x1b[{}F", "\x1b[J"  # to the beginning of the line so many above; to the end of the screen


@dataclass
class Watched:
    """A job: its folder, what it changes, its last state, and when it was first seen to run and to have ended (perf_counter)."""

    folder: Path
    change: str
    job: Job
    began: float | None = None
    ended: float | None = None

    @property
    def over(self) -> bool:
        """True if the job has ended."""
        return self.ended is not None


class Progress:
    """A context that counts the jobs which are done, says which failed and why, and about how long the rest will take."""

    def __init__(self, folders: Sequence[Path], changes: Sequence[str], before: int, total: int) -> None:
        """`before` jobs of `total` are done, those of `folders`, which change what `changes` say, will be."""
        self._jobs = [Watched(folder, change, {}) for folder, change in zip(folders, changes)]
        self._before, self._total = before, total
        self._began, self._stop = time.perf_counter(), threading.Event()
        self._live, self._drawn = sys.stderr.isatty(), 0
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
                watched.ended = now
                ended.append(watched)
        if self._live:
            self._draw(ended, now)
            return
        for watched in ended:
            if watched.job["error"]:
                print(f"trihedron: {watched.job['error']}", file=sys.stderr)
        if ended:
            print(self._summary(now), file=sys.stderr)

    def _summary(self, now: float) -> str:
        done, seconds = sum(job.over for job in self._jobs), now - self._began
        left = f", about {duration(seconds / done * (len(self._jobs) - done))} left" if done else ""
        return f"sweep: {self._before + done} of {self._total} jobs done, {duration(seconds)}{left}"

    def _draw(self, ended: Sequence[Watched], now: float) -> None:
        """Redraw the table in its place; the reason of a failure stays above it."""
        width = shutil.get_terminal_size().columns - 1
        above = [f"trihedron: {watched.job['error']}" for watched in ended if watched.job["error"]]
        lines = [line[:width] for line in [self._summary(now), *self.rows(now)]]
        up = UP.format(self._drawn) + CLEAR if self._drawn else ""
        print(up + "".join(f"{line}\n" for line in [*above, *lines]), end="", file=sys.stderr, flush=True)
        self._drawn = len(lines)

    def rows(self, now: float) -> list[str]:
        """Return the rows of the table: the jobs that run, then those that ended last, as many as there is room for."""
        running = [job for job in self._jobs if not job.over and job.job.get("state") == RUNNING]
        last = sorted((job for job in self._jobs if job.over), key=lambda job: -(job.ended or 0.0))
        shown = [*running, *last][:ROWS]
        spent = [duration((job.ended or now) - (job.began or now)) for job in shown]
        cells = [(job.folder.name, str(job.job.get("state", "")), took, _ate(job), job.change) for job, took in zip(shown, spent)]
        widths = [max((len(row[column]) for row in cells), default=0) for column in range(4)]
        return ["  ".join(["", *(cell.rjust(width) for cell, width in zip(row, widths)), printable(row[4])]) for row in cells]


def _ate(watched: Watched) -> str:
    """The error of a job that is done, else the number of its frames."""
    if watched.job.get("state") != DONE:
        return ""
    try:
        metrics = read_results(watched.folder / METRICS)
        frames = read_results(watched.folder / TIMING).get("frames")
    except DataError:
        return ""
    ate = (metrics.get("final") or {}).get("ate_rmse_m")
    return f"ATE {1e3 * ate:.2f} mm" if ate is not None else f"{frames} frames" if frames else ""


def duration(seconds: float) -> str:
    """Return a time as text of two or three digits."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
