"""Runs a graph over frames on several threads, with the same values whatever their number.

A task is one node at one frame. It is ready when the values of its wires are there: of the same frame, of exactly k frames ago, or, for `@prev`, of
all earlier frames of that topic. Ready tasks run oldest frame first, so tracking precedes features of later frames; within a frame by the longest
remaining path, from measured times of calls. The number of pipelined frames is bounded. Nodes that only later frames read have a thread of their own
at a lower priority, so that no pose waits for them, and so have nodes that wait for a live source. Nodes see only their inputs, so the order in which
tasks happen to run cannot change a value.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import cv2
from threadpoolctl import threadpool_limits

from trihedron.pipeline.core.wires import PREVIOUS, Wire

LATEST = 0.1  # weight of the latest call in the moving average of a node's time
SWITCH_S = 0.0005  # of Python's usual 5 ms
NICE = 10  # of the thread for lagging nodes, where the system has priorities of threads


@dataclass(frozen=True)
class Node:
    """`call(position, inputs)` computes a value or None; `ordered` nodes (folds, topics of a file) never run two frames out of order; one that
    `waits` for a live source occupies no worker meanwhile."""

    name: str
    call: Callable[[int, Mapping[str, Any]], Any]
    inputs: Mapping[str, Wire]
    ordered: bool = False
    waits: bool = False


class Lane(IntEnum):
    """The threads a task is for: the workers, the one for lagging nodes, or the one that waits for a live source."""

    prompt = 0
    lagging = 1
    waiting = 2


class NodeFailure(Exception):
    """A node raised at a position; `__cause__` is what it raised."""

    def __init__(self, node: str, position: int) -> None:
        super().__init__(f"{node} at {position}")
        self.node, self.position = node, position


class NoMoreFrames(Exception):
    """Raised by a node: there is no frame at this position, nor at any later one."""


class Scheduler:
    """Nodes in topological order, `threads` workers, at most `lookahead` pipelined frames.

    A node read only through `@k` wires may lag k frames behind; it does not hold back the others, and with more than one worker another, of lower
    priority, takes it. `initial` holds the values of `@prev` before the first
    frame, `recent` those of `@k`: node -> position (-1: one frame before the first) -> value."""

    def __init__(
        self,
        nodes: list[Node],
        threads: int,
        lookahead: int,
        initial: Mapping[str, Any],
        recent: Mapping[str, Mapping[int, Any]] | None = None,
    ) -> None:
        self._nodes = {node.name: node for node in nodes}
        self._rank = {node.name: i for i, node in enumerate(nodes)}
        self._seconds = dict.fromkeys(self._nodes, 0.0)  # of a call
        self._urgency = dict.fromkeys(self._nodes, 0.0)  # seconds from a node's beginning to the end of its frame, at best
        self._threads, self._initial, self._recent = threads, initial, recent or {}
        delays = [wire.delay for node in nodes for wire in node.inputs.values()]
        self._max_delay = max([1, *delays])
        self._lookahead = lookahead
        self._count = self._admitted = self._consumed = 0
        self._consumers: dict[str, list[tuple[str, int]]] = defaultdict(list)
        for node in nodes:
            for wire in node.inputs.values():
                self._consumers[wire.topic].append((node.name, wire.delay))
            if node.ordered:
                self._consumers[node.name].append((node.name, PREVIOUS))
        self._retained = {name: max([0, *(delay for _, delay in self._consumers[name])]) for name in self._nodes}  # frames for which a value is read
        lagging = {name for name in self._nodes if self._consumers[name] and all(delay > 0 for _, delay in self._consumers[name])}
        self._prompt = set(self._nodes) - lagging
        self._lanes = dict.fromkeys(self._nodes, Lane.prompt)
        self._lanes.update(dict.fromkeys(lagging if threads > 1 else (), Lane.lagging))
        self._lanes.update(dict.fromkeys((node.name for node in nodes if node.waits), Lane.waiting))
        self._lock = threading.Lock()
        self._frame_there = threading.Condition(self._lock)
        self._work_there = {lane: threading.Condition(self._lock) for lane in Lane}
        self._ready: dict[Lane, list[tuple[int, float, int, str]]] = {lane: [] for lane in Lane}
        self._unmet: dict[tuple[str, int], int] = {}
        self._undone: dict[int, int] = {}  # unfinished nodes of a frame
        self._prompt_undone: dict[int, int] = {}  # those of these that may not lag
        self._oldest = 0  # the first frame with an unfinished node that may not lag
        self._values: dict[str, dict[int, Any]] = {name: {} for name in self._nodes}
        self._held: dict[str, dict[int, Any]] = {name: {} for name in self._nodes}
        self._frontier = dict.fromkeys(self._nodes, 0)  # frames done without a gap
        self._running = 0
        self._failure: NodeFailure | None = None
        self._stopped = False

    def run(self, count: int) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield (position, values by node) for 0..count-1 in order, fewer where a node raises NoMoreFrames. After a failure the frames before it
        come, then the finished values of that frame, then NodeFailure is raised."""
        lanes = [Lane.prompt] * self._threads + [lane for lane in (Lane.lagging, Lane.waiting) if lane in self._lanes.values()]
        workers = [threading.Thread(target=self._work, args=(lane,), name=f"stage-{i}", daemon=True) for i, lane in enumerate(lanes)]
        for worker in workers:
            worker.start()
        try:
            self._count = count
            for position in range(count):
                with self._lock:
                    self._consumed = position
                    self._admit()
                    while not self._settled(position):
                        self._frame_there.wait()
                    if position >= self._count:
                        return
                    values = {name: self._values[name][position] for name in self._nodes if position in self._values[name]}
                    self._forget(position)
                yield position, values
                if self._failure is not None and self._failure.position <= position:
                    raise self._failure
        finally:
            with self._lock:
                self._stopped = True
                for there in self._work_there.values():
                    there.notify_all()
            for worker in workers:
                worker.join()

    def _settled(self, position: int) -> bool:
        """Return True if the frame is complete, or none of its nodes will run any more."""
        if self._undone.get(position) == 0:
            return True
        if position >= self._count:
            return not self._running
        idle = not self._running and not any(self._runnable(lane) for lane in Lane)
        return self._failure is not None and self._failure.position <= position and idle

    def _runnable(self, lane: Lane) -> bool:
        ready = self._ready[lane]
        return bool(ready) and ready[0][0] < self._count and (self._failure is None or ready[0][0] <= self._failure.position)

    def _admit(self, mine: Lane | None = None) -> None:
        """Admit frames while few enough are pipelined and the consumer keeps up, and wake idle threads, for one task less in the caller's lane."""
        limit = min(self._count, self._oldest + self._lookahead, self._consumed + self._lookahead + self._max_delay)
        while self._admitted < limit:
            self._judge_urgency()
            self._undone[self._admitted], self._prompt_undone[self._admitted] = len(self._nodes), len(self._prompt)
            for name, node in self._nodes.items():
                wires = [*node.inputs.values(), *([Wire(name, PREVIOUS)] if node.ordered else [])]
                self._unmet[name, self._admitted] = sum(not self._there(wire, self._admitted) for wire in wires)
            for name in self._nodes:
                self._offer(name, self._admitted)
            self._admitted += 1
        for lane, ready in self._ready.items():
            if len(ready) > (lane is mine):
                self._work_there[lane].notify(len(ready) - (lane is mine))

    def _judge_urgency(self) -> None:
        """Update the upward ranks of list scheduling (Topcuoglu, Hariri, Wu: HEFT, 2002)."""
        for name in reversed(self._nodes):
            after = max((self._urgency[consumer] for consumer, delay in self._consumers[name] if delay == 0), default=0.0)
            self._urgency[name] = self._seconds[name] + after

    def _there(self, wire: Wire, position: int) -> bool:
        if wire.delay == PREVIOUS:
            return self._frontier[wire.topic] >= position
        source = position - wire.delay
        return source < 0 or source < self._frontier[wire.topic] or source in self._values[wire.topic]

    def _offer(self, name: str, position: int) -> None:
        if self._unmet[name, position] == 0:
            heapq.heappush(self._ready[self._lanes[name]], (position, -self._urgency[name], self._rank[name], name))

    def _work(self, lane: Lane) -> None:
        if lane is Lane.lagging:
            with contextlib.suppress(OSError, AttributeError):  # Linux has a priority for each thread
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        while True:
            with self._lock:
                self._work_there[lane].wait_for(lambda: self._stopped or self._runnable(lane))
                if self._stopped:
                    return
                position, *_, name = heapq.heappop(self._ready[lane])
                inputs = {parameter: self._input(wire, position) for parameter, wire in self._nodes[name].inputs.items()}
                self._running += 1
            failure: NodeFailure | None = None
            value, ended, began = None, False, time.perf_counter()
            try:
                value = self._nodes[name].call(position, inputs)
            except NoMoreFrames:
                ended = True
            except BaseException as error:  # handed to the main thread, which raises it
                failure = NodeFailure(name, position)
                failure.__cause__ = error
            with self._lock:
                self._running -= 1
                self._seconds[name] += LATEST * (time.perf_counter() - began - self._seconds[name])
                if ended:
                    self._count = min(self._count, position)
                elif failure is None:
                    self._complete(name, position, value)
                    self._admit(lane)
                elif self._failure is None or (position, self._rank[name]) < (self._failure.position, self._rank[self._failure.node]):
                    self._failure = failure
                if self._failure is not None or self._count <= self._consumed or self._settled(self._consumed):
                    self._frame_there.notify()

    def _input(self, wire: Wire, position: int) -> Any:
        if wire.delay == PREVIOUS:
            return self._held[wire.topic][position - 1] if position else self._initial.get(wire.topic)
        source = position - wire.delay
        return self._values[wire.topic][source] if source >= 0 else self._recent.get(wire.topic, {}).get(source)

    def _complete(self, name: str, position: int, value: Any) -> None:
        self._values[name][position] = value
        self._undone[position] -= 1
        if name in self._prompt:
            self._prompt_undone[position] -= 1
        while self._prompt_undone.get(self._oldest) == 0:
            del self._prompt_undone[self._oldest]
            self._oldest += 1
        for consumer, delay in self._consumers[name]:
            if delay != PREVIOUS:
                self._meet(consumer, position + delay)
        while self._frontier[name] in self._values[name]:
            front = self._frontier[name]
            latest = self._values[name][front]
            if latest is None:
                latest = self._held[name][front - 1] if front else self._initial.get(name)
            self._held[name][front] = latest
            self._frontier[name] = front + 1
            for consumer, delay in self._consumers[name]:
                if delay == PREVIOUS:
                    self._meet(consumer, front + 1)

    def _meet(self, name: str, position: int) -> None:
        if (name, position) in self._unmet:
            self._unmet[name, position] -= 1
            self._offer(name, position)

    def _forget(self, position: int) -> None:
        """Drop the values that no later frame can read once `position` is complete."""
        self._undone.pop(position, None)
        for name in self._nodes:
            self._unmet.pop((name, position), None)
            self._values[name].pop(position - self._retained[name], None)
            self._held[name].pop(position - 1, None)


@contextlib.contextmanager
def single_threaded_libraries() -> Iterator[None]:
    """One thread per library: the runner parallelises stages itself, and sums split over threads would change with their number. A thread that
    waits for the interpreter gets it after `SWITCH_S`: a stage returns from compiled code some hundred times a frame."""
    before, switch_s = cv2.getNumThreads(), sys.getswitchinterval()
    cv2.setNumThreads(1)
    sys.setswitchinterval(SWITCH_S)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)
        sys.setswitchinterval(switch_s)
