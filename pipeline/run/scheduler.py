"""Runs a graph over frames on several threads, with the same values whatever their number.

A task is one node at one frame. Which tasks may run is in `readiness`, in what order in `task_order`, and what is kept of their values in
`kept_values`; here are the threads. The number of pipelined frames is bounded. Nodes that only later frames read have a thread of their own at a
lower priority, so that no pose waits for them, and so have nodes that wait for a live source. Nodes see only their inputs, so the order in which
tasks happen to run cannot change a value.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from enum import IntEnum
from typing import Any

import cv2
from threadpoolctl import threadpool_limits

from trihedron.pipeline.run.interpreter_stack import call_with_room
from trihedron.pipeline.run.kept_values import KeptValues
from trihedron.pipeline.run.node import Node, NodeFailure, NoMoreFrames, consumers_of, lagging_nodes
from trihedron.pipeline.run.readiness import Readiness, Task
from trihedron.pipeline.run.task_order import ReadyTasks, TaskOrder

SWITCH_S = 0.0005  # of Python's usual 5 ms
NICE = 10  # of the thread for lagging nodes, where the system has priorities of threads


class Lane(IntEnum):
    """The threads a task is for: the workers, the one for lagging nodes, or the one that waits for a live source."""

    prompt = 0
    lagging = 1
    waiting = 2


class Scheduler:
    """Nodes in topological order, `threads` workers, at most `lookahead` pipelined frames.

    A node read only through `@k` wires may lag k frames behind; it does not hold back the others, and with more than one worker another, of lower
    priority, takes it. `initial` and `recent` are the values before the first frame, see `KeptValues`."""

    def __init__(
        self,
        nodes: list[Node],
        threads: int,
        lookahead: int,
        initial: Mapping[str, Any],
        recent: Mapping[str, Mapping[int, Any]] | None = None,
    ) -> None:
        self._nodes = {node.name: node for node in nodes}
        consumers = consumers_of(nodes)
        self.kept = KeptValues(consumers, initial, recent or {})
        self._readiness, self._order = Readiness(nodes, consumers, self.kept), TaskOrder(nodes, consumers)
        lagging = lagging_nodes(consumers)
        self._prompt = set(self._nodes) - lagging
        self._lanes = dict.fromkeys(self._nodes, Lane.prompt)
        self._lanes.update(dict.fromkeys(lagging if threads > 1 else (), Lane.lagging))
        self._lanes.update(dict.fromkeys((node.name for node in nodes if node.waits), Lane.waiting))
        self._ready = {lane: ReadyTasks() for lane in Lane}
        self._threads, self._lookahead = threads, lookahead
        self._max_delay = max([1, *(wire.delay for node in nodes for wire in node.inputs.values())])
        self._count = self._admitted = self._consumed = 0
        self._undone: dict[int, int] = {}  # unfinished nodes of a frame
        self._prompt_undone: dict[int, int] = {}  # those of these that may not lag
        self._oldest = 0  # the first frame with an unfinished node that may not lag
        self._lock = threading.Lock()
        self._frame_there = threading.Condition(self._lock)
        self._work_there = {lane: threading.Condition(self._lock) for lane in Lane}
        self._running = 0
        self._failure: NodeFailure | None = None
        self._stopped = False

    def run(self, count: int) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield (position, values by node) for 0..count-1 in order, fewer where a node raises NoMoreFrames. After a failure the frames before it
        come, then the finished values of that frame, then NodeFailure is raised."""
        lanes = [Lane.prompt] * self._threads + [lane for lane in (Lane.lagging, Lane.waiting) if lane in self._lanes.values()]
        workers = [threading.Thread(target=call_with_room, args=(self._work, lane), name=f"stage-{i}", daemon=True) for i, lane in enumerate(lanes)]
        for worker in workers:
            worker.start()
        try:
            self._count = count
            for position in range(count):
                with self._lock:
                    self._consumed = position
                    self._admit()
                    while not self._is_finished(position):
                        self._frame_there.wait()
                    if position >= self._count:
                        return
                    values = self.kept.of_frame(position)
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

    def _is_finished(self, position: int) -> bool:
        """Return True if the frame is complete, or none of its nodes will run any more."""
        if self._undone.get(position) == 0:
            return True
        if position >= self._count:
            return not self._running
        idle = not self._running and not any(self._runnable(lane) for lane in Lane)
        return self._failure is not None and self._failure.position <= position and idle

    def _runnable(self, lane: Lane) -> bool:
        ready = self._ready[lane]
        return bool(ready) and ready.oldest < self._count and (self._failure is None or ready.oldest <= self._failure.position)

    def _admit(self, mine: Lane | None = None) -> None:
        """Admit frames while few enough are pipelined and the consumer keeps up, and wake idle threads, for one task less in the caller's lane."""
        limit = min(self._count, self._oldest + self._lookahead, self._consumed + self._lookahead + self._max_delay)
        while self._admitted < limit:
            self._order.update()
            self._undone[self._admitted], self._prompt_undone[self._admitted] = len(self._nodes), len(self._prompt)
            self._offer(self._readiness.admit(self._admitted))
            self._admitted += 1
        for lane, ready in self._ready.items():
            if len(ready) > (lane is mine):
                self._work_there[lane].notify(len(ready) - (lane is mine))

    def _offer(self, tasks: Iterable[Task]) -> None:
        for task in tasks:
            self._ready[self._lanes[task[0]]].push(task, self._order.key(task))

    def _work(self, lane: Lane) -> None:
        if lane is Lane.lagging and sys.platform == "linux":  # which has a priority for each thread
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        while True:
            with self._lock:
                self._work_there[lane].wait_for(lambda: self._stopped or self._runnable(lane))
                if self._stopped:
                    return
                name, position = self._ready[lane].pop()
                inputs = {parameter: self.kept.read(wire, position) for parameter, wire in self._nodes[name].inputs.items()}
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
                self._order.measure(name, time.perf_counter() - began)
                if ended:
                    self._count = min(self._count, position)
                elif failure is None:
                    self._complete(name, position, value)
                    self._admit(lane)
                elif self._failure is None or self._before(failure, self._failure):
                    self._failure = failure
                if self._failure is not None or self._count <= self._consumed or self._is_finished(self._consumed):
                    self._frame_there.notify()

    def _before(self, one: NodeFailure, other: NodeFailure) -> bool:
        """Return whether one thread alone would have met the first failure before the other."""
        return (one.position, self._order.number(one.node)) < (other.position, self._order.number(other.node))

    def _complete(self, name: str, position: int, value: Any) -> None:
        self._undone[position] -= 1
        if name in self._prompt:
            self._prompt_undone[position] -= 1
        while self._prompt_undone.get(self._oldest) == 0:
            del self._prompt_undone[self._oldest]
            self._oldest += 1
        self._offer(self._readiness.complete(name, position, self.kept.put(name, position, value)))

    def _forget(self, position: int) -> None:
        """Drop what no later frame can read once `position` is complete."""
        self._undone.pop(position, None)
        self._readiness.forget(position)
        self.kept.forget(position)


class _ProcessSettings:
    """Settings of the process, made by the first of several runs at once and undone by the last, in whatever order and thread they end."""

    def __init__(self) -> None:
        self._lock, self._users, self._undo = threading.Lock(), 0, contextlib.ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            self._users += 1
            if self._users == 1:
                self._undo.callback(cv2.setNumThreads, cv2.getNumThreads())
                self._undo.callback(sys.setswitchinterval, sys.getswitchinterval())
                cv2.setNumThreads(1)
                sys.setswitchinterval(SWITCH_S)
                self._undo.enter_context(threadpool_limits(1, user_api="blas"))

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._undo.close()


_SETTINGS = _ProcessSettings()


@contextlib.contextmanager
def single_threaded_libraries() -> Iterator[None]:
    """One thread per library: the runner parallelises stages itself, and sums split over threads would change with their number. A thread that
    waits for the interpreter gets it after `SWITCH_S`: a stage returns from compiled code some hundred times a frame."""
    with _SETTINGS, threadpool_limits(1, user_api="openmp"):  # OpenMP's is a setting of the calling thread
        yield
