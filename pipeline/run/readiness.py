"""Tasks that may run: one node at one frame is ready when all that its wires read is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from trihedron.pipeline.core.wires import PREVIOUS
from trihedron.pipeline.run.kept_values import KeptValues
from trihedron.pipeline.run.node import Consumers, Node

Task = tuple[str, int]  # node, position


class Readiness:
    """Counts for each task of the admitted frames the wires whose values are not known yet."""

    def __init__(self, nodes: Sequence[Node], consumers: Consumers, kept: KeptValues) -> None:
        self._awaited = {node.name: node.awaited_wires for node in nodes}
        self._consumers, self._kept = consumers, kept
        self._unmet: dict[Task, int] = {}

    def admit(self, position: int) -> Iterator[Task]:
        """Take in a frame; returns its tasks that are ready at once, in the order of the nodes."""
        for name, wires in self._awaited.items():
            self._unmet[name, position] = sum(not self._kept.is_known(wire, position) for wire in wires)
        return ((name, position) for name in self._awaited if self._unmet[name, position] == 0)

    def complete(self, name: str, position: int, known: range) -> Iterator[Task]:
        """Return the tasks that the value of a node at a position makes ready; `known` is what `KeptValues.put` returned."""
        for consumer, delay in self._consumers[name]:
            if delay != PREVIOUS:
                yield from self._meet(consumer, position + delay)
        for front in known:
            for consumer, delay in self._consumers[name]:
                if delay == PREVIOUS:
                    yield from self._meet(consumer, front)

    def _meet(self, name: str, position: int) -> Iterator[Task]:
        task = name, position
        if task in self._unmet:
            self._unmet[task] -= 1
            if self._unmet[task] == 0:
                yield task

    def forget(self, position: int) -> None:
        """Drop the counts of a frame that is done."""
        for name in self._awaited:
            self._unmet.pop((name, position), None)
