"""Several graphs over the frames of one recording, side by side: whatever two of them have in common is read and computed once.

Stages of two graphs are equivalent when plugin, options and wires are equal and all that they read, delayed wires included, is equivalent: the
coarsest stable partition (Hopcroft, 1971: the minimisation of automata). Equivalent stages compute the same bytes, so one node serves them all.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from trihedron.pipeline.core.errors import StageError, TrihedronError
from trihedron.pipeline.core.graph import Graph, Stage
from trihedron.pipeline.core.types import F64
from trihedron.pipeline.core.wires import Wire
from trihedron.pipeline.run.interrupts import Interrupts
from trihedron.pipeline.run.node import Node, NodeFailure
from trihedron.pipeline.run.runner import Runner
from trihedron.pipeline.run.scheduler import Scheduler, single_threaded_libraries
from trihedron.pipeline.run.warm_up import CompilerClock

DATASET = "dataset"
MAP = "map"  # what the end of a fold reads besides its wires
Class = TypeVar("Class", bound=Hashable)


@dataclass(frozen=True)
class Vertex:
    """A stage as the partition sees it: its plugin, and the wires to what it reads."""

    plugin: Any
    inputs: Mapping[str, Wire]


def vertices_of(graph: Graph) -> dict[str, Vertex]:
    """Return the stages of a graph; a fold reads the map as well."""
    return {name: Vertex(stage.plugin, _inputs(stage, stage.inputs, graph)) for name, stage in graph.stages.items()}


def _inputs(stage: Stage, inputs: Mapping[str, Wire], graph: Graph) -> dict[str, Wire]:
    return {**inputs, **({"": Wire(MAP)} if stage.fold and MAP in graph.stages else {})}


def equivalence(graphs: Sequence[Mapping[str, Vertex]]) -> list[dict[str, int]]:
    """Return for each graph stage -> number of its class: equal numbers compute equal values. A topic that is no stage is equal in all of them."""
    known: list[tuple[str, Vertex]] = []
    classes = [{name: _class_number(known, name, vertex) for name, vertex in graph.items()} for graph in graphs]
    while True:
        numbers: dict[Any, int] = {}
        refined = [
            {name: numbers.setdefault(_signature(own, name, vertex), len(numbers)) for name, vertex in graph.items()}
            for graph, own in zip(graphs, classes)
        ]
        if len(numbers) == len({number for own in classes for number in own.values()}):
            return refined
        classes = refined


def _signature(own: Mapping[str, int], name: str, vertex: Vertex) -> tuple[Any, ...]:
    """The class so far, which differs where wires or delays do, and the classes of all that is read."""
    return own[name], *(own.get(wire.topic, wire.topic) for _, wire in sorted(vertex.inputs.items()))


def _class_number(known: list[tuple[str, Vertex]], name: str, vertex: Vertex) -> int:
    for number, (other, candidate) in enumerate(known):
        if other == name and candidate.inputs == vertex.inputs and _same(candidate.plugin, vertex.plugin):
            return number
    known.append((name, vertex))
    return len(known) - 1


def _same(a: Any, b: Any) -> bool:
    return type(a) is type(b) and all(getattr(a, field.name) == getattr(b, field.name) for field in fields(a))


def changed_stages(graphs: Sequence[Graph]) -> frozenset[str]:
    """Return the stages whose values may differ between the graphs: those that differ, and all that follow from them over wires and delayed wires."""
    return _unequal(graphs, equivalence([vertices_of(graph) for graph in graphs]))


def swapped_stages(graphs: Sequence[Graph]) -> frozenset[str]:
    """Return the stages that themselves differ between the graphs."""
    known: list[tuple[str, Vertex]] = []
    return _unequal(graphs, [{name: _class_number(known, name, vertex) for name, vertex in vertices_of(graph).items()} for graph in graphs])


def with_one_dataset(graphs: Sequence[Graph]) -> list[Graph]:
    """Return the graphs with one reader for all equal data sets, which is opened, and warns, once."""
    known: list[tuple[str, Vertex]] = []
    readers = [graph.stages[DATASET] for graph in graphs]
    numbers = [_class_number(known, DATASET, Vertex(reader.plugin, reader.inputs)) for reader in readers]
    return [replace(graph, stages={**graph.stages, DATASET: readers[numbers.index(number)]}) for graph, number in zip(graphs, numbers)]


def _unequal(graphs: Sequence[Graph], classes: Sequence[Mapping[str, int]]) -> frozenset[str]:
    names = {name for graph in graphs for name in graph.stages}
    return frozenset(name for name in names if len({own.get(name) for own in classes}) > 1)


def users_of(classes: Sequence[Mapping[str, Class]]) -> dict[Class, list[int]]:
    """Return for each class of stages the numbers of the graphs that have it; `classes` as of `equivalence`."""
    found: dict[Class, list[int]] = defaultdict(list)
    for number, own in enumerate(classes):
        for name in own.values():
            found[name].append(number)
    return dict(found)


class SideBySide:
    """Replays of one recording that advance together, frame by frame. `cpu_s` has the CPU seconds of each node so far, without those of the
    compiler, `node_of` the node that serves a stage of a runner, `users` how many runners a node serves."""

    def __init__(self, runners: Sequence[Runner], threads: int) -> None:
        self.runners, self.threads = runners, threads
        self.count = min(runner.count for runner in runners)
        own = [{node.name: node for node in runner.nodes()} for runner in runners]
        classes = equivalence([self._vertices(runner, nodes) for runner, nodes in zip(runners, own)])
        self.node_of: list[dict[str, str]] = []
        self._owner: dict[str, tuple[int, str]] = {}  # node -> the runner that computes it, and the stage
        self._calls: dict[str, dict[int, float]] = defaultdict(dict)
        self._compiler = CompilerClock()
        for number, (runner, nodes, numbers) in enumerate(zip(runners, own, classes)):
            self.node_of.append({name: f"{name}:{number if self._fold(runner, name) else ''}{numbers[name]}" for name in nodes})
            for name, node in self.node_of[-1].items():
                self._owner.setdefault(node, (number, name))
        self._nodes = [self._timed_node(node, *self._owner[node], own) for node in self._owner]
        for runner in runners:
            runner.validation = runners[0].validation

    @staticmethod
    def _fold(runner: Runner, name: str) -> bool:
        return name in runner.graph.stages and runner.graph.stages[name].fold

    @staticmethod
    def _vertices(runner: Runner, nodes: Mapping[str, Node]) -> dict[str, Vertex]:
        stages = runner.graph.stages
        return {name: Vertex(stages[name].plugin, node.inputs) if name in stages else Vertex(Wire(name), {}) for name, node in nodes.items()}

    @property
    def users(self) -> dict[str, int]:
        """The number of runners that each node serves."""
        return {node: len(numbers) for node, numbers in users_of(self.node_of).items()}

    @property
    def cpu_s(self) -> dict[str, float]:
        """CPU seconds of the calls of each node so far."""
        return {node: sum(calls.values()) for node, calls in self._calls.items()}

    def cpu_ms_of_frames(self, nodes: Collection[str]) -> F64:
        """CPU milliseconds of the calls of some nodes in each frame (count,)."""
        return np.array([1e3 * sum(self._calls[node].get(position, 0.0) for node in nodes) for position in range(self.count)])

    def _timed_node(self, name: str, number: int, stage: str, own: Sequence[Mapping[str, Node]]) -> Node:
        """The node of a runner under its common name, with its CPU time measured, but for what is compiled once."""
        node, names, seconds = own[number][stage], self.node_of[number], self._calls[name]

        def call(position: int, inputs: Mapping[str, Any]) -> Any:
            began, compiling = time.thread_time(), self._compiler.seconds()
            value = node.call(position, inputs)
            seconds[position] = time.thread_time() - began - (self._compiler.seconds() - compiling)
            return value

        return replace(node, name=name, call=call, inputs={p: Wire(names[wire.topic], wire.delay) for p, wire in node.inputs.items()})

    def steps(self) -> Iterator[tuple[int, list[dict[str, Any]]]]:
        """Run, yielding the number of each finished frame and the values of each runner; sinks are the runners' own. Raises TrihedronError."""
        held = {node: self.runners[k].initial.held[name] for node, (k, name) in self._owner.items() if name in self.runners[k].initial.held}
        before = [runner.recent() for runner in self.runners]
        recent = {node: before[k][name] for node, (k, name) in self._owner.items() if name in before[k]}
        scheduler = Scheduler(self._nodes, self.threads, self.threads, held, recent)
        try:
            with single_threaded_libraries(), self._compiler, Interrupts() as interrupts:
                for position, values in scheduler.run(self.count):
                    each = [{name: values[node] for name, node in nodes.items() if node in values} for nodes in self.node_of]
                    with interrupts.defer():
                        self._share_times(position)
                        for runner, one in zip(self.runners, each):
                            runner.take(position, one)
                    yield self.runners[0].indices[position], each
                for runner in self.runners:
                    runner.finish()
        except NodeFailure as failure:
            raise self._explain(failure) from failure.__cause__

    def _share_times(self, position: int) -> None:
        """Give every runner the times of the nodes that serve it. A frame's time is their sum: a latency means nothing here."""
        times = [runner.accounts.times_at(position) for runner in self.runners]
        for mine, nodes in zip(times, self.node_of):
            for name, node in nodes.items():
                if name in (calls := times[self._owner[node][0]].calls_ms):
                    mine.calls_ms[name] = calls[name]
        for mine in times:
            mine.latency_ms = None

    def _explain(self, failure: NodeFailure) -> TrihedronError:
        number, stage = self._owner[failure.node]
        named = NodeFailure(stage, failure.position)
        named.__cause__ = failure.__cause__
        error = self.runners[number].explain(named, None)
        return StageError(error.place, error.cause, "leave out the value that chose it") if isinstance(error, StageError) else error
