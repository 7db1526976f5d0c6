"""Compare two recordings value by value: the first topic, frame and field in which they differ, and by how much; then every topic that differs.

Only frames and topics that both have are compared; a line names the frames that one of them lacks, and without --topics the topics. Exit code 0 when
all of it is equal, bit for bit, 1 when not. With --tolerance real numbers are equal that differ by no more: |a - b| <= T max(1, |a|, |b|); each field
that differs is listed with its largest such difference. Libraries of linear algebra round differently on other processors.

Example: trihedron diff runs/a/run.mcap runs/b/run.mcap --topics pose,map
Example: trihedron diff runs/a/run.mcap runs/b/run.mcap --tolerance 1e-6
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison.value_differences import arrays_of, common_frames, difference, size_of
from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import Value
from trihedron.pipeline.record.codec import FRAMES_TOPIC
from trihedron.pipeline.record.embedded_images import topic_of
from trihedron.pipeline.record.reader import Recording, TopicReader
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Run the command; returns 0 for equal, 1 for different. Raises RecordingError for an unreadable file, DataError with nothing to compare."""
    parser = Parser("diff", __name__)
    parser.add_argument("a", metavar="A.mcap", type=Path)
    parser.add_argument("b", metavar="B.mcap", type=Path)
    parser.add_argument("--topics", metavar="TOPIC,...", default="", help="(default: all that both have)")
    parser.add_argument("--tolerance", metavar="T", type=float, help="list every field that differs, and call equal what differs by T at most")
    arguments = parser.parse(argv)
    if arguments.tolerance is not None and not 0.0 <= arguments.tolerance < np.inf:
        raise UsageError("--tolerance", f"{arguments.tolerance:g} is not a tolerance", "give a number from 0")
    a, b = Recording(arguments.a), Recording(arguments.b)
    topics, frames = _topics(a, b, arguments.topics), common_frames(a, b)
    _report_lacking(a, b, bool(arguments.topics))
    if arguments.tolerance is not None:
        return _within(a, b, topics, frames, arguments.tolerance)
    found = [found for topic in topics if (found := difference(a, b, topic, frames)) is not None]
    if not found:
        print(f"equal: {len(frames)} frames ({frames[0]}..{frames[-1]}) of {', '.join(topics)}")
        return 0
    first = min(found, key=lambda one: one.frame)
    print(f"{first.topic}, frame {first.frame}, {first.field}: {first.size}")
    rows = [["topic", "first frame", "field", "difference there", f"frames of {len(frames)}"]]
    rows += [[one.topic, str(one.frame), one.field, one.size, str(one.frames)] for one in found]
    print(table(rows, "lrllr"))
    return 1


def _report_lacking(a: Recording, b: Recording, chosen: bool) -> None:
    """Print the topics, unless some were chosen, and the frames that one recording has and the other lacks."""
    frames = {file: {value.index for value in file.references} for file in (a, b)}
    for file, other in ((a, b), (b, a)):
        if not chosen and (lacking := sorted(other.topics - file.topics)):
            print(f"{file.path} has no {', '.join(lacking)}")
        if missing := frames[other] - frames[file]:
            print(f"{file.path} lacks {len(missing)} frames of the other ({min(missing)}..{max(missing)})")


def _within(a: Recording, b: Recording, topics: list[str], frames: list[int], tolerance: float) -> int:
    """Print every field that differs, with its largest difference; returns 0 when none differs by more than the tolerance."""
    rows = [["topic", "field", "largest difference", "frame", ""]]
    for topic in topics:
        worst: dict[str, tuple[float, int]] = {}
        readers = TopicReader(a, topic, check=False), TopicReader(b, topic, check=False)
        for frame in frames:
            for field, apart in _apart(*(reader.at(frame) for reader in readers)):
                if apart > worst.get(field, (-1.0, 0))[0]:
                    worst[field] = apart, frame
        for field, (apart, frame) in worst.items():
            verdict = f"equal within {tolerance:g}" if apart <= tolerance else "different"
            rows.append([topic, field, f"{apart:.2g}" if np.isfinite(apart) else "not comparable", str(frame), verdict])
    if len(rows) > 1:
        print(table(rows, "llrll"))
    different = sum(row[-1] == "different" for row in rows)
    print(f"{'different' if different else 'equal'} within {tolerance:g}: {len(frames)} frames ({frames[0]}..{frames[-1]}) of {', '.join(topics)}")
    return int(different > 0)


def _apart(x: Value | None, y: Value | None) -> Iterator[tuple[str, float]]:
    """(field, largest |a - b| / max(1, |a|, |b|)) of all fields that differ; infinite where they are of another kind or shape, or text."""
    if x is None or y is None or type(x) is not type(y):
        if x is not y:
            yield "value", np.inf
        return
    for name, one, other in arrays_of(x, y, ""):
        if size_of(one, other) is not None:
            yield name, _relative(one, other)


def _relative(x: Any, y: Any) -> float:
    if x.shape != y.shape or x.dtype.kind != y.dtype.kind or x.dtype.kind == "U":
        return float("inf")
    whole = x.dtype.kind != "f"  # ids and counts are equal or not
    with np.errstate(all="ignore"):
        x, y = x.astype(np.float64), y.astype(np.float64)
        apart = np.abs(x - y) / (1.0 if whole else np.maximum(1.0, np.maximum(np.abs(x), np.abs(y))))
    same = (x == y) | (np.isnan(x) & np.isnan(y))
    return float(np.max(np.where(same, 0.0, np.where(np.isnan(apart), np.inf, apart)), initial=0.0))


def _topics(a: Recording, b: Recording, words: str) -> list[str]:
    """The topics to compare, in the order in which they were first written."""
    common = [topic for topic in dict.fromkeys(map(topic_of, a.channels)) if topic in a.topics & b.topics and topic != FRAMES_TOPIC]
    for word in filter(None, words.split(",")):
        if word not in common:
            raise DataError(f"--topics {word}", "is not a topic of both recordings", did_you_mean(word, common))
    chosen = words.split(",") if words else common
    if not chosen:
        raise DataError(f"{a.path}, {b.path}", "have no topic in common", "compare two runs of the same stages")
    return [topic for topic in common if topic in chosen]
