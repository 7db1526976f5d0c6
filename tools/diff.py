"""Compare two recordings value by value: the first topic, frame and field in which they differ, and by how much; then every topic that differs.

Only frames and topics that both have are compared; what one of them lacks is reported. Exit code 0 when all of it is equal, bit for bit, 1 when not.

Example: trihedron diff runs/a/run.mcap runs/b/run.mcap --topics pose,map
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError, did_you_mean
from trihedron.pipeline.core.types import Table, Value
from trihedron.pipeline.record.codec import FRAMES_TOPIC
from trihedron.pipeline.record.reader import Recording, TopicReader
from trihedron.tools.arguments import Parser, table


@dataclass
class Difference:
    """The difference of a topic: its first frame and field, the size there (text), and the number of common frames that differ."""

    topic: str
    frame: int
    field: str
    size: str
    frames: int = 1


def main(argv: list[str]) -> int:
    """Run the command; returns 0 for equal, 1 for different. Raises RecordingError for an unreadable file, DataError with nothing to compare."""
    parser = Parser("diff", __name__)
    parser.add_argument("a", metavar="A.mcap", type=Path)
    parser.add_argument("b", metavar="B.mcap", type=Path)
    parser.add_argument("--topics", metavar="TOPIC,...", default="", help="(default: all that both have)")
    arguments = parser.parse_args(argv)
    a, b = Recording(arguments.a), Recording(arguments.b)
    topics, frames = _topics(a, b, arguments.topics), _frames(a, b)
    found = [found for topic in topics if (found := difference(a, b, topic, frames)) is not None]
    for file, other in ((a, b), (b, a)):
        if lacking := sorted(other.topics - file.topics):
            print(f"{file.path} has no {', '.join(lacking)}")
    if not found:
        print(f"equal: {len(frames)} frames ({frames[0]}..{frames[-1]}) of {', '.join(topics)}")
        return 0
    first = min(found, key=lambda one: one.frame)
    print(f"{first.topic}, frame {first.frame}, {first.field}: {first.size}")
    rows = [["topic", "first frame", "field", "difference there", f"frames of {len(frames)}"]]
    rows += [[one.topic, str(one.frame), one.field, one.size, str(one.frames)] for one in found]
    print(table(rows, "lrllr"))
    return 1


def _topics(a: Recording, b: Recording, words: str) -> list[str]:
    """The topics to compare, in the order in which they were first written."""
    common = [channel[1:] for channel in a.channels if channel[1:] in a.topics & b.topics and channel[1:] != FRAMES_TOPIC]
    for word in filter(None, words.split(",")):
        if word not in common:
            raise DataError(f"--topics {word}", "is not a topic of both recordings", did_you_mean(word, common))
    chosen = words.split(",") if words else common
    if not chosen:
        raise DataError(f"{a.path}, {b.path}", "have no topic in common", "compare two runs of the same stages")
    return [topic for topic in common if topic in chosen]


def _frames(a: Recording, b: Recording) -> list[int]:
    """The numbers of the frames that both have."""
    numbers = [{value.index for value in recording.values(FRAMES_TOPIC)} for recording in (a, b)]
    if not numbers[0] & numbers[1]:
        raise DataError(f"{a.path}, {b.path}", "have no frame in common", "compare two runs over the same frames")
    return sorted(numbers[0] & numbers[1])


def difference(a: Recording, b: Recording, topic: str, frames: list[int]) -> Difference | None:
    """Compare a topic in the given frames; None where it is equal."""
    readers, found = (TopicReader(a, topic), TopicReader(b, topic)), None
    for frame in frames:
        x, y = (reader.at(frame) for reader in readers)
        first = next(_differing(x, y), None)
        if first is not None and found is None:
            found = Difference(topic, frame, *first)
        elif first is not None and found is not None:
            found.frames += 1
    return found


def _differing(x: Value | None, y: Value | None) -> Iterator[tuple[str, str]]:
    """(field, size of the difference) of all fields that differ."""
    if x is None or y is None:
        if x is not y:
            yield "value", "only in the " + ("second" if x is None else "first")
    elif type(x) is not type(y):
        yield "type", f"{type(x).__name__} and {type(y).__name__}"
    else:
        yield from _fields(x, y, "")


def _fields(x: Any, y: Any, prefix: str) -> Iterator[tuple[str, str]]:
    for field in fields(x):
        name, one, other = prefix + field.name, getattr(x, field.name), getattr(y, field.name)
        if isinstance(one, Table):
            yield from _columns(one, other, name)
        elif is_dataclass(one):
            yield from _fields(one, other, f"{name}.")
        elif (size := _size(np.asarray(one), np.asarray(other))) is not None:
            yield name, size


def _columns(x: Table, y: Table, name: str) -> Iterator[tuple[str, str]]:
    for column in x.schema:
        if column not in y.schema:
            yield f"{name}.{column}", "only in the first"
        elif (size := _size(x.column(column), y.column(column))) is not None:
            yield f"{name}.{column}", size


def _size(x: Any, y: Any) -> str | None:
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
