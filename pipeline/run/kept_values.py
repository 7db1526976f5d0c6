"""Values of nodes, kept from their call until no wire can read them any more."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trihedron.pipeline.core.wires import PREVIOUS, Wire
from trihedron.pipeline.run.node import Consumers


class KeptValues:
    """Values by node and position. A wire `@prev` reads the latest value before a position that is not None; it is known once all earlier frames of
    the node are done. `initial` holds it before the first frame; `recent` the values that wires `@k` read there: node -> position (-1: one frame
    before the first) -> value."""

    def __init__(self, consumers: Consumers, initial: Mapping[str, Any], recent: Mapping[str, Mapping[int, Any]]) -> None:
        self._initial, self._recent = initial, recent
        self._reach = {name: max([0, *(delay for _, delay in readers)]) for name, readers in consumers.items()}  # frames for which a value is read
        self.values: dict[str, dict[int, Any]] = {name: {} for name in consumers}
        self.latest: dict[str, dict[int, Any]] = {name: {} for name in consumers}  # up to each position, not None
        self._done = dict.fromkeys(consumers, 0)  # frames without a gap

    def put(self, name: str, position: int, value: Any) -> range:
        """Keep a value; returns the positions for which the latest earlier value of the node is known from now on."""
        values, latest, begin = self.values[name], self.latest[name], self._done[name]
        values[position] = value
        end = begin
        while end in values:
            before = latest[end - 1] if end else self._initial.get(name)
            latest[end] = before if values[end] is None else values[end]
            end += 1
        self._done[name] = end
        return range(begin + 1, end + 1)

    def is_known(self, wire: Wire, position: int) -> bool:
        """Return whether what a wire reads at a position is known, if only as nothing."""
        if wire.delay == PREVIOUS:
            return self._done[wire.topic] >= position
        source = position - wire.delay
        return source < 0 or source < self._done[wire.topic] or source in self.values[wire.topic]

    def read(self, wire: Wire, position: int) -> Any:
        """Return what a wire reads at a position where it is known."""
        if wire.delay == PREVIOUS:
            return self.latest[wire.topic][position - 1] if position else self._initial.get(wire.topic)
        source = position - wire.delay
        return self.values[wire.topic][source] if source >= 0 else self._recent.get(wire.topic, {}).get(source)

    def of_frame(self, position: int) -> dict[str, Any]:
        """Return the values at a position by node."""
        return {name: values[position] for name, values in self.values.items() if position in values}

    def forget(self, position: int) -> None:
        """Drop the values that no frame behind a position can read."""
        for name, values in self.values.items():
            values.pop(position - self._reach[name], None)
            self.latest[name].pop(position - 1, None)
