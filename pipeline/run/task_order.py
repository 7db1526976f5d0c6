"""The order of ready tasks: those of the oldest frame first, and within a frame those after which most remains to be done."""

from __future__ import annotations

import heapq
from collections.abc import Sequence

from trihedron.pipeline.run.node import Consumers, Node
from trihedron.pipeline.run.readiness import Task

LATEST = 0.1  # weight of the latest call in the moving average of a node's time


class TaskOrder:
    """The upward ranks of list scheduling (Topcuoglu, Hariri, Wu: HEFT, 2002): seconds from a node's beginning to the end of its frame, by the
    measured times of calls. Equal ones are in topological order."""

    def __init__(self, nodes: Sequence[Node], consumers: Consumers) -> None:
        """Take nodes in topological order."""
        self._after = {node.name: [name for name, delay in consumers[node.name] if delay == 0] for node in nodes}
        self._number = {node.name: number for number, node in enumerate(nodes)}
        self._seconds = dict.fromkeys(self._number, 0.0)  # of a call
        self._rank = dict.fromkeys(self._number, 0.0)

    def measure(self, name: str, seconds: float) -> None:
        """Take the time of a call."""
        self._seconds[name] += LATEST * (seconds - self._seconds[name])

    def update(self) -> None:
        """Compute the ranks from the times so far."""
        for name in reversed(self._number):
            self._rank[name] = self._seconds[name] + max((self._rank[consumer] for consumer in self._after[name]), default=0.0)

    def key(self, task: Task) -> tuple[int, float, int]:
        """Return the key of a task: less comes first."""
        name, position = task
        return position, -self._rank[name], self._number[name]

    def number(self, name: str) -> int:
        """Return the place of a node in topological order."""
        return self._number[name]


class ReadyTasks:
    """The ready tasks of one lane, first come those of the least keys."""

    def __init__(self) -> None:
        self._heap: list[tuple[tuple[int, float, int], str]] = []

    def __len__(self) -> int:
        return len(self._heap)

    @property
    def oldest(self) -> int:
        """The position of the first task, which there must be."""
        return self._heap[0][0][0]

    def push(self, task: Task, key: tuple[int, float, int]) -> None:
        """Add a task."""
        heapq.heappush(self._heap, (key, task[0]))

    def pop(self) -> Task:
        """Take the first task."""
        (position, *_), name = heapq.heappop(self._heap)
        return name, position
