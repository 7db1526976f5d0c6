"""The nodes that a scheduler runs: stages, and readers of recorded topics, each a function with wires from other nodes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from trihedron.pipeline.core.wires import PREVIOUS, Wire

Consumers = Mapping[str, Sequence[tuple[str, int]]]  # node -> the nodes that read it, with the delay of their wires


@dataclass(frozen=True)
class Node:
    """`call(position, inputs)` computes a value or None; `ordered` nodes (folds, topics of a file) never run two frames out of order; one that
    `waits` for a live source occupies no worker meanwhile."""

    name: str
    call: Callable[[int, Mapping[str, Any]], Any]
    inputs: Mapping[str, Wire]
    ordered: bool = False
    waits: bool = False

    @property
    def awaited_wires(self) -> tuple[Wire, ...]:
        """The wires whose values must be there before a call: those of the inputs, and of an ordered node its own earlier frames."""
        return (*self.inputs.values(), *([Wire(self.name, PREVIOUS)] if self.ordered else []))


class NodeFailure(Exception):
    """Raised for a node that raised at a position; `__cause__` is what it raised."""

    def __init__(self, node: str, position: int) -> None:
        super().__init__(f"{node} at {position}")
        self.node, self.position = node, position


class NoMoreFrames(Exception):
    """Raised by a node: there is no frame at this position, nor at any later one."""


def consumers_of(nodes: Sequence[Node]) -> Consumers:
    """Return for each node those that wait for its values."""
    found: dict[str, list[tuple[str, int]]] = defaultdict(list)
    for node in nodes:
        for wire in node.awaited_wires:
            found[wire.topic].append((node.name, wire.delay))
    return {node.name: found[node.name] for node in nodes}


def lagging_nodes(consumers: Consumers) -> set[str]:
    """Return the nodes that only later frames read: their frame can end without them."""
    return {name for name, readers in consumers.items() if readers and all(delay > 0 for _, delay in readers)}
