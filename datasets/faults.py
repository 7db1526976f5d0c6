"""Another data set with what goes wrong in the field: for tests of what a system says and does then."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any, get_type_hints

import numpy as np

from trihedron.pipeline.registry import plugin_class, register
from trihedron.pipeline.slots import frame_range
from trihedron.pipeline.types import Frame, Trajectory


class Covered(Enum):
    """Which of the two images a cover blinds: colour turns black, depth to 0."""

    both = "both"
    color = "color"
    depth = "depth"


@register("dataset", "faults")
@dataclass(frozen=True)
class Faults:
    """The data set `of` with its camera covered for a while."""

    frames: str = ""  # part to read, half open: A:B, A:, :B; empty = all
    of: str = "synthetic"  # the data set underneath
    options: dict[str, Any] = field(default_factory=dict)  # its options: +dataset.options.path=FOLDER
    cover: str = ""  # frames A:B for which the camera is covered; empty = never
    covered: Covered = Covered.both  # both | color | depth

    def __post_init__(self) -> None:
        frame_range(self.frames)
        if self.cover:
            frame_range(self.cover)
        if self.of == "faults" or "frames" in self.options:
            raise ValueError("of, options: another data set, its frames chosen by dataset.frames")
        self._inner  # noqa: B018  an option out of range is refused now

    def __len__(self) -> int:
        return len(self._inner)

    def __call__(self, index: int) -> Frame | None:
        """Frame `index` of the selection, blinded where the camera is covered."""
        frame: Frame | None = self._inner(index)
        if frame is None or not self._is_covered(frame.index):
            return frame
        color = frame.color if self.covered is Covered.depth else np.zeros_like(frame.color)
        depth = frame.depth_m if self.covered is Covered.color else np.zeros_like(frame.depth_m)
        return replace(frame, color=color, depth_m=depth)

    def truth(self) -> Trajectory | None:
        """That of the data set underneath."""
        truth: Trajectory | None = self._inner.truth()
        return truth

    def _is_covered(self, number: int) -> bool:
        first, stop = frame_range(self.cover)
        return bool(self.cover) and first <= number and (stop is None or number < stop)

    @cached_property
    def _inner(self) -> Any:
        kind = plugin_class("dataset", self.of)
        hints = get_type_hints(kind)
        given = {name: _as(hints.get(name), value) for name, value in self.options.items()}
        return kind(**given, **({"frames": self.frames} if self.frames else {}))


def _as(hint: Any, value: Any) -> Any:
    """A name as the member of an enumeration where one is wanted. Raises ValueError for a name it has not."""
    if isinstance(hint, type) and issubclass(hint, Enum) and not isinstance(value, hint):
        if value not in hint.__members__:
            raise ValueError(f"options: '{value}' is not one of {', '.join(hint.__members__)}")
        return hint[value]
    return value
