"""Differences of two recordings: frames, topics and fields in which their values are not equal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from itertools import zip_longest
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import Table, Value
from trihedron.pipeline.record.reader import Recording, TopicReader


@dataclass
class Difference:
    """The difference of a topic: its first frame and field, the size there (text), and the number of common frames that differ."""

    topic: str
    frame: int
    field: str
    size: str
    frames: int = 1


def common_frames(a: Recording, b: Recording) -> list[int]:
    """The numbers of the frames that both have."""
    numbers = [{value.index for value in recording.references} for recording in (a, b)]
    if not numbers[0] & numbers[1]:
        raise DataError(f"{a.path}, {b.path}", "have no frame in common", "compare two runs over the same frames")
    return sorted(numbers[0] & numbers[1])


def difference(a: Recording, b: Recording, topic: str, frames: list[int]) -> Difference | None:
    """Compare a topic in the given frames; None where it is equal. Messages that are equal from the first to the last are not decoded."""
    if all(one == other for one, other in zip_longest(a.messages(f"/{topic}"), b.messages(f"/{topic}"))):
        return None
    readers, found = (TopicReader(a, topic, check=False), TopicReader(b, topic, check=False)), None
    for frame in frames:
        x, y = (reader.at(frame) for reader in readers)
        first = next(differing(x, y), None)
        if first is not None and found is None:
            found = Difference(topic, frame, *first)
        elif first is not None and found is not None:
            found.frames += 1
    return found


def differing(x: Value | None, y: Value | None) -> Iterator[tuple[str, str]]:
    """(field, size of the difference) of all fields that differ."""
    if x is None or y is None:
        if x is not y:
            yield "value", "only in the " + ("second" if x is None else "first")
    elif type(x) is not type(y):
        yield "type", f"{type(x).__name__} and {type(y).__name__}"
    else:
        yield from _fields(x, y, "")


def _fields(x: Any, y: Any, prefix: str) -> Iterator[tuple[str, str]]:
    for name, one, other in arrays_of(x, y, prefix):
        if (size := size_of(one, other)) is not None:
            yield name, size


def arrays_of(x: Any, y: Any, prefix: str) -> Iterator[tuple[str, Any, Any]]:
    """(field, array of one, of the other) of two values of a type; a table gives its columns, one that only the first has an empty text instead."""
    for field in fields(x):
        name, one, other = prefix + field.name, getattr(x, field.name), getattr(y, field.name)
        if isinstance(one, Table):
            for column in one.schema:
                missing = column not in other.schema
                yield f"{name}.{column}", one.column(column), np.asarray("") if missing else other.column(column)
        elif is_dataclass(one):
            yield from arrays_of(one, other, f"{name}.")
        else:
            yield name, np.asarray(one), np.asarray(other)


def size_of(x: Any, y: Any) -> str | None:
    """Describe the difference of two arrays or scalars; None when they are bit-identical."""
    if x.shape != y.shape or x.dtype.kind != y.dtype.kind:
        return f"{x.dtype}{list(x.shape)} and {y.dtype}{list(y.shape)}" if x.dtype.kind not in "U" else f"'{x}' and '{y}'"
    if x.tobytes() == y.tobytes() and x.dtype == y.dtype:
        return None
    if x.dtype.kind == "U":
        return f"'{x}' and '{y}'"
    differ = ~((x == y) | ((x != x) & (y != y)))
    if not differ.any():
        return "signs of zeros or bits of NaN"
    apart = np.abs(x.astype(np.float64) - y.astype(np.float64))[differ]
    most = np.nanmax(apart) if np.isfinite(apart).any() else np.nan
    where = np.argwhere(differ)[0].tolist() if x.ndim else []
    return f"up to {most:.3g} in {differ.sum()} of {x.size}" + (f", first at {where}" if where else "")
