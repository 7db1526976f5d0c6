"""A wire: the topic an input reads, and of which frame."""

from __future__ import annotations

import re
from dataclasses import dataclass

from trihedron.pipeline.core.errors import GraphError

PREVIOUS = -1  # delay of `topic@prev`


@dataclass(frozen=True)
class Wire:
    """The source of an input: a topic of the same frame (delay 0), of exactly `delay` frames ago, or its latest earlier value (PREVIOUS)."""

    topic: str
    delay: int = 0

    def __str__(self) -> str:
        return self.topic + ("" if self.delay == 0 else "@prev" if self.delay == PREVIOUS else f"@{self.delay}")


def parse_wire(text: str, place: str) -> Wire:
    """Parse `topic`, `topic@prev` or `topic@5`. Raises GraphError for anything else."""
    match = re.fullmatch(r"(\w+)(?:@(prev|[1-9]\d*))?", str(text))
    if not match:
        raise GraphError(place, f"'{text}' is not a wire", "write topic, topic@prev or topic@5")
    delay = match[2]
    return Wire(match[1], 0 if delay is None else PREVIOUS if delay == "prev" else int(delay))
