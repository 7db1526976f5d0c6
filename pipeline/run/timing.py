"""Times and memory of a run: milliseconds of each call, latency of each frame, resident memory."""

from __future__ import annotations

import gc
import os
import time
from array import array
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.run.memory import malloc_trim

_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6


class Timing:
    """Collects milliseconds per stage and per frame; `summary` is `timing.json`."""

    def __init__(self) -> None:
        self._calls: dict[str, array[float]] = defaultdict(lambda: array("f"))
        self._frames_ms = array("d")
        self._finish_ms: dict[str, float] = {}
        self.cpu_s = time.process_time()  # at the beginning, and the memory there
        self.earlier_peak_mb: float | None = None
        self.begin_mb: float | None = None

    def begin(self) -> None:
        """Start the measurement of this process's CPU time and of the run's own memory, at the first frame."""
        begin_together([self])

    def add_call(self, stage: str, ms: float) -> None:
        """Add one call of a stage."""
        self._calls[stage].append(ms)

    def add_finish(self, stage: str, ms: float) -> None:
        """Add the end of a fold."""
        self._finish_ms[stage] = ms

    def add_frame(self, ms: float) -> None:
        """Add the latency of one frame, from reading it to its pose."""
        self._frames_ms.append(ms)

    def summary(self, threads: int, wall_s: float, startup_s: float) -> dict[str, Any]:
        """Return frames, wall time and percentiles; `fps` is the whole run's, with reading and recording; `cpu_s` is the
        process's CPU time since `begin`, of all threads, `startup_s` imports and composition. `peak_memory_mb` is the process's, with its libraries;
        `own_memory_mb` is the growth of the peak above the resident memory at `begin`, which earlier runs in the process do not change (None where
        the peak cannot be restarted; of runs side by side it is that of all)."""
        frames, peak = len(self._frames_ms), peak_mb()
        p50, p95, largest = _percentiles(self._frames_ms)
        stages: dict[str, dict[str, float]] = {}
        for name, calls in self._calls.items():
            half, high, _ = _percentiles(calls)
            stages[name] = {"calls": len(calls), "p50_ms": half, "p95_ms": high}
        for name, ms in self._finish_ms.items():
            stages.setdefault(name, {"calls": 0})["finish_ms"] = round(ms, 1)
        return {
            "frames": frames,
            "threads": threads,
            "wall_s": round(wall_s, 3),
            "cpu_s": round(time.process_time() - self.cpu_s, 3),
            "startup_s": round(startup_s, 3),
            "fps": round(frames / wall_s, 2) if wall_s > 0 else 0.0,
            "frame_ms": {"p50": p50, "p95": p95, "max": largest},
            "peak_memory_mb": None if peak is None else max(peak, self.earlier_peak_mb or 0.0),
            "own_memory_mb": None if peak is None or self.begin_mb is None else round(max(peak - self.begin_mb, 0.0), 1),
            "stages": stages,
        }


def begin_together(timings: Sequence[Timing]) -> None:
    """Begin the measurements of runs that advance side by side: the peak of the process is restarted once."""
    earlier_mb = peak_mb()
    begin_mb = resident_mb() if forget_peak() else None
    for timing in timings:
        timing.earlier_peak_mb, timing.begin_mb, timing.cpu_s = earlier_mb, begin_mb, time.process_time()


def resident_mb() -> float:
    """Return the resident memory of this process (10⁶ bytes), on Linux; 0 elsewhere. Read for each frame, so the file stays open."""
    file = _statistics(os.getpid())
    return int(os.pread(file, 100, 0).split()[1]) * _PAGE_MB if file is not None else 0.0


@cache
def _statistics(process: int) -> int | None:
    """Open the file once a process: a forked one would read that of the other."""
    try:
        return os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None


def peak_mb() -> float | None:
    """Return the peak memory (10⁶ bytes) of this process since `forget_peak`, on Linux; None elsewhere."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((round(int(line.split()[1]) * 1.024e-3, 1) for line in lines if line.startswith("VmHWM:")), None)


def forget_peak() -> bool:
    """Restart the measurement of the peak, without the memory of earlier runs. Returns False where that is not permitted."""
    gc.collect()
    malloc_trim()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
        return True
    return False


def _percentiles(values: Sequence[float]) -> tuple[float, float, float]:
    if not values:
        return 0.0, 0.0, 0.0
    p50, p95 = np.percentile(values, [50, 95])
    return round(float(p50), 3), round(float(p95), 3), round(max(values), 3)
