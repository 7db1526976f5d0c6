"""A long run in one process: memory, handles, threads and latency while the camera sees the same again and again.

A walk of --loop frames is made once and shown forwards and backwards until there are --frames of them, so that the map is complete after the first
--warm-up and what grows from there on is a leak. It runs and is recorded as by `trihedron run`, 320×240 unless overridden. Each row is a thousand
frames (--span): what the process holds (median), the map's living rows, times from hand-over to pose, the largest error of a position. Times are also
given as multiples of those of the feature stages in the same frames, whatever else the machine does.

Example: trihedron benchmark long --frames 20000 --json long.json
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.core.slots import output_of
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import F64, OK, Frame, Map, Pose, Trajectory
from trihedron.pipeline.record.codec import TIMING_TOPIC, timing_of
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.runner import Runner
from trihedron.tools.arguments import Parser
from trihedron.tools.benchmarks.map_benchmark import FEATURES, bytes_of, promises
from trihedron.tools.benchmarks.recording_benchmark import graph_of_words

SMALL = ("dataset.width=320", "dataset.height=240")
PERIOD_NS = 33_333_333
GROWTH, SLOWER = 0.05, 0.1  # shares by which memory and times of the last rows may exceed those of the first after the warm-up
HEAD = ("frames", "memory MB", "handles", "threads", "keyframes", "landmarks", "map MB", "p50 ms", "p95 ms", "× features", "off mm", "not ok")


@dataclass(frozen=True)
class BackAndForth:
    """A data set of `count` frames: those given, forwards, backwards and so on."""

    frames: Sequence[Frame]
    count: int

    def __len__(self) -> int:
        return self.count

    def __call__(self, index: int) -> Frame | None:
        """The frame shown at place `index`, as if it were new."""
        return replace(self.frames[self.source_index(index)], index=index, stamp_ns=index * PERIOD_NS)

    def truth(self) -> Trajectory | None:
        """None: the errors are this command's to count."""
        return None

    def source_index(self, index: int) -> int:
        """Frames that are shown."""
        there = index % max(2 * len(self.frames) - 2, 1)
        return min(there, 2 * len(self.frames) - 2 - there)


@dataclass(frozen=True)
class Row:
    """State at the end of a span of frames, and over it."""

    frames: int
    memory_mb: float
    handles: int
    threads: int
    keyframes: int
    landmarks: int
    map_mb: float
    p50_ms: float
    p95_ms: float
    multiple: float
    most_mm: float
    not_ok: int


def main(argv: list[str]) -> int:
    """Run and print the table; returns 0, or 1 when a promise is not kept."""
    from trihedron.tools.benchmark import machine

    parser = Parser("benchmark long", __name__)
    for name, default, what in (("frames", 20_000, "shown"), ("loop", 150, "of the walk"), ("warm-up", 2000, "not judged"), ("span", 1000, "a row")):
        parser.add_argument(f"--{name}", type=int, default=default, metavar="N", help=f"frames {what} (default {default})")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    arguments, overrides = parser.parse_known_args(argv)
    if arguments.span < 1 or arguments.loop < 2 or arguments.frames < arguments.warm_up + 2 * arguments.span:
        raise UsageError("benchmark long", "there are too few frames for two rows after the warm-up", "give more --frames, or a shorter --span")
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(graph_of_words([*SMALL, *overrides]), Path(folder) / "run.mcap", arguments.frames, arguments.loop, arguments.span)
    text, kept = report(rows, arguments.warm_up)
    print(text)
    if arguments.json:
        write_file(arguments.json, json.dumps({"machine": machine(), "rows": [asdict(row) for row in rows]}, indent=2) + "\n")
    return 0 if kept else 1


def measure(graph: Graph, path: Path, count: int, loop: int, span: int) -> list[Row]:
    """One row for each full span of a run of the graph over the first `loop` frames of its data set, shown until there are `count`."""
    stage = graph.stages["dataset"]
    frames = [frame for i in range(min(loop, len(stage.plugin))) if isinstance(frame := stage.plugin(i), Frame)]
    true = stage.plugin.truth()
    stamps = [frame.stamp_ns for frame in frames]
    places = true.poses[np.searchsorted(true.stamps_ns, stamps)] if true is not None else None
    shown = BackAndForth(frames, count)
    graph = replace(graph, stages={**graph.stages, "dataset": replace(stage, plugin=shown)})
    writer = RecordingWriter(path, {"overrides": "[]"})
    topics = frozenset(name for name in graph.stages if not output_of(name).dense)
    held, map = [], None
    errors_mm, not_ok = np.zeros(count), np.zeros(count, bool)
    for step in Runner(graph).steps(writer, topics):
        map, pose = step.values.get("map") or map, step.values["pose"]
        if isinstance(pose, Pose):
            not_ok[step.index] = pose.status != OK
            errors_mm[step.index] = _off_mm(pose, places, shown) if places is not None else np.nan
        if (step.index + 1) % span == 0 and isinstance(map, Map):
            held.append((len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task")), *_living(map), bytes_of(map) / 1e6))
    writer.close()
    timing = [timing_of(data) for _, data in Recording(path).messages(TIMING_TOPIC)]
    return [_row(k * span, timing[k * span : (k + 1) * span], here, errors_mm, not_ok) for k, here in enumerate(held)]


def _off_mm(pose: Pose, places: F64, shown: BackAndForth) -> float:
    """Error of the position, in the world of the first frame."""
    true = np.linalg.solve(places[0], places[shown.source_index(pose.index)])
    return 1e3 * float(np.linalg.norm(true[:3, 3] - pose.T_world_camera[:3, 3]))


def _living(map: Map) -> tuple[int, int]:
    """Count the living keyframes and landmarks."""
    landmarks = sum(np.count_nonzero(kind.column("alive")) for kind in (map.points, map.lines, map.planes))
    return int(np.count_nonzero(map.keyframes.column("alive"))), int(landmarks)


def _row(first: int, timing: list[dict[str, Any]], held: tuple[int, int, int, int, float], errors_mm: F64, not_ok: Any) -> Row:
    frame_ms = np.array([row["frame_ms"] for row in timing])
    features = np.array([sum(row["stage_ms"].get(name, 0.0) for name in FEATURES) for row in timing])
    others = np.array([sum(row["stage_ms"].values()) - row["stage_ms"]["dataset"] for row in timing]) - features
    inside = slice(first, first + len(timing))
    handles, threads, keyframes, landmarks, map_mb = held
    memory_mb = round(float(np.median([row["memory_mb"] for row in timing])), 1)  # what waits to be written makes single frames differ by 20 MB
    p50, p95 = np.percentile(frame_ms, [50, 95])
    times = round(float(p50), 2), round(float(p95), 2), round(float(np.median(others / features)), 3)
    off_mm, count = round(float(errors_mm[inside].max()), 2), int(not_ok[inside].sum())
    return Row(first + len(timing), memory_mb, handles, threads, keyframes, landmarks, round(map_mb, 2), *times, off_mm, count)


def report(rows: list[Row], warm_up: int) -> tuple[str, bool]:
    """The table with its verdicts, and whether all promises are kept."""
    judged = [row for row in rows if row.frames > warm_up]
    first, last = judged[0], judged[-1]
    of = (
        (f"memory grew by {_more(first.memory_mb, last.memory_mb)}, at most 5 %", last.memory_mb <= (1.0 + GROWTH) * first.memory_mb),
        ("no more handles and threads", last.handles <= first.handles and last.threads <= first.threads),
        (f"p95 changed by {_more(first.p95_ms, last.p95_ms)}, at most 10 %", last.p95_ms <= (1.0 + SLOWER) * first.p95_ms),
        (f"the stages after the features by {_more(first.multiple, last.multiple)}, at most 10 %", last.multiple <= (1.0 + SLOWER) * first.multiple),
    )
    text = table([HEAD, *(tuple(asdict(row).values()) for row in rows)], "r" * len(HEAD))
    return f"{rows[-1].frames} frames of the same\n{text}{promises(*of)}", all(met for _, met in of)


def _more(before: float, after: float) -> str:
    return f"{100.0 * (after / before - 1.0):+.1f} %"
