"""The budget of a run: how long a frame may take, and which words of the command line hold, one after the other, where frames take longer.

The decision is made before a frame is read, from the latency of those before it, and is recorded with it (topic `effort`). A replay takes it from
there, and so computes each frame as the run did.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from trihedron.pipeline.core.graph import Stage

log = logging.getLogger("trihedron")
EFFORT_TOPIC = "effort"
WINDOW = 10  # frames whose mean latency is compared with the budget
PATIENCE, LONGEST_PATIENCE = 60, 1920  # frames before the last word is tried without; doubled whenever that was tried


@dataclass(frozen=True)
class Budget:
    """`ms`: the mean latency that a run may have, from when a frame is there to its pose. `words`, and the stages that they change, hold from the
    first on, one more whenever that is exceeded; each stage is as all words up to its own make it. `first` of them hold at the first frame."""

    ms: float
    words: tuple[str, ...]
    stages: tuple[Stage, ...]
    first: int = 0

    def each(self) -> list[Budget]:
        """Return the budget with one word from the first frame on, with two, and so on."""
        return [replace(self, first=count + 1) for count in range(len(self.words))]

    def in_force(self, stage: Stage, level: int) -> Stage:
        """Return what takes the place of a stage of the graph when `level` words hold."""
        return next((changed for changed in reversed(self.stages[:level]) if changed.name == stage.name), stage)


class Decisions(Protocol):
    """Number of words that hold at each frame."""

    def level(self, position: int) -> int:
        """Return the number at a position, from any thread."""
        ...

    def take(self, position: int, index: int, latency_ms: float) -> int:
        """Take note of a finished frame, in order; returns its number of words."""
        ...


class Governor:
    """Decides by the latency: one more word holds where its mean over WINDOW frames exceeds the budget. The last one is dropped after a while if what
    it saved, when it was taken, would fit into the budget again."""

    def __init__(self, budget: Budget) -> None:
        self._budget, self._now = budget, budget.first
        self._decided: dict[int, int] = {}
        self._lock = threading.Lock()
        self._recent: deque[float] = deque(maxlen=WINDOW)
        self._before: list[float] = [budget.ms] * budget.first  # mean latency when each word in force was taken
        self._saved: float | None = None  # share of the latency that is left with the last word; None before WINDOW frames with it
        self._since, self._patience = 0, PATIENCE

    def level(self, position: int) -> int:
        """Return the number of words that hold at a position: that of when it is first asked for."""
        with self._lock:
            return self._decided.setdefault(position, self._now)

    def take(self, position: int, index: int, latency_ms: float) -> int:
        """Take note of a finished frame, and decide for those that are not begun."""
        level = self.level(position)
        with self._lock:
            del self._decided[position]
            if level == self._now:
                self._recent.append(latency_ms)
                self._since += 1
                self._decide(index)
        return level

    def _decide(self, index: int) -> None:
        if len(self._recent) < WINDOW:
            return
        mean = sum(self._recent) / WINDOW
        if self._before and self._saved is None:
            self._saved = mean / self._before[-1]
        if mean > self._budget.ms:
            if self._now < len(self._budget.words):
                log.warning("budget_ms: frames take %.1f ms; after frame %d with %s", mean, index, self._budget.words[self._now])
                self._before.append(mean)
                self._change(self._now + 1)
        elif self._before and self._since >= self._patience and mean < self._budget.ms * min(self._saved or 1.0, 1.0):
            log.warning("budget_ms: frames take %.1f ms; after frame %d without %s", mean, index, self._budget.words[self._now - 1])
            self._before.pop()
            self._patience = min(2 * self._patience, LONGEST_PATIENCE)
            self._change(self._now - 1)

    def _change(self, level: int) -> None:
        self._now, self._saved, self._since = level, None, 0
        self._recent.clear()


class RecordedDecisions:
    """The decisions of the run that a replay repeats: frame number -> words in force."""

    def __init__(self, levels: Mapping[int, int], indices: Sequence[int]) -> None:
        self._levels, self._indices = levels, indices

    def level(self, position: int) -> int:
        """Return the number of words that held at a position."""
        return self._levels.get(self._indices[position], 0)

    def take(self, position: int, index: int, latency_ms: float) -> int:
        """Return the number of words of a finished frame."""
        return self._levels.get(index, 0)


class BudgetedStages:
    """The stages that are called at each frame to keep a budget, and the count of frames by the number of words."""

    def __init__(self, budget: Budget, decisions: Decisions) -> None:
        self.budget, self._decisions = budget, decisions
        self._frames: Counter[int] = Counter()

    def stage(self, stage: Stage, position: int) -> Stage:
        """Return the stage to call at a position."""
        return self.budget.in_force(stage, self._decisions.level(position))

    def take(self, position: int, index: int, latency_ms: float) -> int:
        """Take note of a finished frame; returns the number of words that held."""
        level = self._decisions.take(position, index, latency_ms)
        self._frames[level] += 1
        return level

    def summary(self) -> dict[str, Any]:
        """Return the budget and the numbers of frames with none of its words, the first, the first two …"""
        return {"ms": self.budget.ms, "words": list(self.budget.words), "frames": [self._frames[k] for k in range(len(self.budget.words) + 1)]}
