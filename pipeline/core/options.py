"""Ranges of options, declared in the annotations of a plugin's fields and checked when the plugin is constructed.

    cone_deg: Annotated[float, Range(0, 45)] = 12.0
    window: Annotated[int, OneOf(3, 5, 7)] = 5

`registry.register` checks every construction; `trihedron plugins` shows the ranges. A condition over several options stays in `__post_init__`.
"""

from __future__ import annotations

import re
import sys
from abc import abstractmethod
from contextlib import suppress
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Annotated, Any, get_type_hints


class Constraint:
    """A set of permitted values; `str` completes the sentence "VALUE is not …"."""

    @abstractmethod
    def permits(self, value: Any) -> bool:
        """Return True if the value is in the set."""


@dataclass(frozen=True)
class Range(Constraint):
    """The numbers from `low` to `high`, both included, or strictly `above` one and `below` another; NaN is in no range."""

    low: float | None = None
    high: float | None = None
    above: float | None = None
    below: float | None = None

    def permits(self, value: Any) -> bool:
        """Return True if a number is within all bounds that are given."""
        return bool(
            value == value
            and (self.low is None or value >= self.low)
            and (self.high is None or value <= self.high)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    def __str__(self) -> str:
        if self.low is not None and self.high is not None:
            return f"within {self.low} … {self.high}"
        if self == Range(above=0):
            return "positive"
        bounds = (("at least", self.low), ("above", self.above), ("at most", self.high), ("below", self.below))
        return " and ".join(f"{word} {bound}" for word, bound in bounds if bound is not None)


@dataclass(frozen=True, init=False)
class OneOf(Constraint):
    """A few values that are permitted, for example `OneOf(3, 5, 7)`; an Enum is the type of choices with names."""

    choices: tuple[Any, ...]

    def __init__(self, *choices: Any) -> None:
        object.__setattr__(self, "choices", choices)

    def permits(self, value: Any) -> bool:
        """Return True if the value is one of the choices."""
        return value in self.choices

    def __str__(self) -> str:
        return "one of " + ", ".join(map(str, self.choices))


def frame_range(text: str) -> range:
    """Parse a half-open range of frames: "A:B", "A:", ":B" or "" for all, and "A:B:S" for every S-th of them -> their numbers in the data set, which
    go on to `sys.maxsize` where no end is given. Raises ValueError."""
    match = re.fullmatch(r"\s*(\d*)\s*:\s*(\d*)\s*(?::\s*(\d*)\s*)?", text or ":")
    start, stop, step = (int(given or default) for given, default in zip(match.groups(), (0, sys.maxsize, 1), strict=True)) if match else (0, 0, 0)
    if start >= stop or step < 1:
        raise ValueError(f"frames: '{text}' is not {FrameRange()}")
    return range(start, stop, step)


@dataclass(frozen=True)
class FrameRange(Constraint):
    """The texts that `frame_range` parses."""

    def permits(self, value: Any) -> bool:
        """Return True if the text is a range of frames."""
        with suppress(ValueError):
            frame_range(value)
            return True
        return False

    def __str__(self) -> str:
        return "a range of frames A:B[:S] with A < B, S > 0"


Frames = Annotated[str, FrameRange()]
PositiveInt = Annotated[int, Range(1)]
NonNegativeInt = Annotated[int, Range(0)]
PositiveFloat = Annotated[float, Range(above=0)]
NonNegativeFloat = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1)]  # a fraction of a whole
PositiveShare = Annotated[float, Range(above=0, high=1)]
AcuteDeg = Annotated[float, Range(above=0, below=90)]  # an angle between directions without sign


_CONSTRAINTS: dict[type[Any], dict[str, tuple[Constraint, ...]]] = {}


def constraints_of(plugin: type[Any]) -> dict[str, tuple[Constraint, ...]]:
    """Return option -> its constraints, for the options of a dataclass that have any; read once, because each construction of a plugin asks."""
    if plugin not in _CONSTRAINTS:
        hints = get_type_hints(plugin, include_extras=True)
        declared = {f.name: tuple(e for e in getattr(hints[f.name], "__metadata__", ()) if isinstance(e, Constraint)) for f in fields(plugin)}
        _CONSTRAINTS[plugin] = {name: constraints for name, constraints in declared.items() if constraints}
    return _CONSTRAINTS[plugin]


def check_options(plugin: Any) -> None:
    """Raise ValueError, `OPTION: VALUE is not RANGE`, for the first option of a dataclass instance that is out of its range."""
    for name, constraints in constraints_of(type(plugin)).items():
        value = getattr(plugin, name)
        for constraint in constraints:
            try:
                permitted = constraint.permits(value)
            except TypeError:  # of another kind
                permitted = False
            if not permitted:
                raise ValueError(f"{name}: {value!r} is not {constraint}")


def check_increasing(plugin: Any, *names: str) -> None:
    """Raise ValueError for an option out of its range, or unless each of these options is at most the next."""
    check_options(plugin)
    for low, high in pairwise(names):
        if not getattr(plugin, low) <= getattr(plugin, high):
            raise ValueError(f"{low}: {getattr(plugin, low)!r} is not at most {high}, {getattr(plugin, high)!r}")
