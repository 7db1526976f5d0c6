"""Cost of recording: time and bytes of a run beside the same run without, frames embedded a second, and how fast one frame of many is read.

    recording   runs alternate without and with; each with is compared with the two without about it, as the machine's speed changes, and the median
                counts. The share is of CPU time, which waits do not count in, and bytes are those of the file
    embedding   the frames of the run, written one after the other with record.frames=true
    reading     a recording in which the run's topics repeat until there are --frames of them: opened, and every topic of one frame decoded; of
                ten frames spread over the run the one that takes longest, for a map is built on messages before it

Example: trihedron benchmark recording dataset=tum dataset.path=FOLDER dataset.frames=0:150
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.core.slots import output_of
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import Frame, Value
from trihedron.pipeline.record.codec import FRAMES_TOPIC
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.runner import Runner
from trihedron.tools.arguments import Parser
from trihedron.tools.topics import topics_of

MOST_SHARE, MOST_KB, LEAST_FRAMES_S, MOST_OPEN_S = 0.08, 170.0, 60.0, 0.5
IMAGES = "/view/image"


def main(argv: list[str]) -> int:
    """Run the command; returns 0, or 1 when a limit is not kept."""
    parser = Parser("benchmark recording", __name__)
    parser.add_argument("--frames", type=int, default=10_000, metavar="N", help="of the long recording (default 10000)")
    parser.add_argument("--repeat", type=int, default=5, metavar="N", help="runs with, one more without (default 5)")
    arguments, overrides = parser.parse_known_args(argv)
    verdicts: list[tuple[str, bool]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        verdicts += _recording(overrides, folder, arguments.repeat)
        verdicts += _embedding(overrides, folder)
        verdicts += _reading(folder, arguments.frames)
    for text, kept in verdicts:
        print(f"{'met' if kept else 'NOT met'}: {text}")
    return 0 if all(kept for _, kept in verdicts) else 1


def _recording(overrides: Sequence[str], folder: Path, repeat: int) -> list[tuple[str, bool]]:
    graph = graph_of_words(overrides)
    topics = frozenset(name for name in graph.stages if not output_of(name).dense)
    seconds: dict[bool, list[tuple[float, float]]] = {False: [], True: []}  # wall and CPU
    for run in range(-2, 2 * repeat + 1):
        recorded = run % 2 == 1
        writer = RecordingWriter(folder / "run.mcap", {"overrides": "[]"}) if recorded else None
        wall, cpu = time.perf_counter(), time.process_time()
        runner = Runner(graph)
        for _ in runner.steps(writer, topics):
            pass
        if writer is not None:
            writer.close()
        if run >= 0:  # those before load what is loaded once
            seconds[recorded].append((time.perf_counter() - wall, time.process_time() - cpu))
    count = len(runner.result.stamps_ns)
    without, with_it = np.array(seconds[False]), np.array(seconds[True])
    (wall, cpu), (wall_with, cpu_with) = (1e3 * np.median(rows, axis=0) / count for rows in (without, with_it))
    more, share = np.median(with_it / (0.5 * (without[1:] + without[:-1])), axis=0) - 1.0
    kb = _sizes(folder / "run.mcap", count)
    print(f"{count} frames: {cpu:.2f} ms CPU a frame without, {cpu_with:.2f} ms with recording ({100 * share:+.1f} %);")
    print(f"wall {wall:.2f} and {wall_with:.2f} ms ({100 * more:+.1f} %), the medians of {repeat} runs between runs without")
    verdict = f"recording adds {100 * share:.1f} % to the run's CPU time, at most {100 * MOST_SHARE:.0f} %"
    return [(verdict, bool(share <= MOST_SHARE)), (f"{kb:.1f} kB a frame beyond the images, at most {MOST_KB:.0f}", kb <= MOST_KB)]


def _sizes(path: Path, count: int) -> float:
    """Print kB a frame of each topic before compression; returns those of the file without the images."""
    found = topics_of(path)
    rows = [["topic", "kB a frame"]]
    rows += [[topic.name, f"{topic.bytes / count / 1e3:.2f}"] for topic in sorted(found, key=lambda topic: -topic.bytes)]
    rows.append(["together", f"{sum(topic.bytes for topic in found) / count / 1e3:.2f}"])
    rows.append(["in the file, compressed", f"{path.stat().st_size / count / 1e3:.2f}"])
    print(table(rows, "lr"))
    images = sum(topic.bytes for topic in found if topic.name == IMAGES)
    return (path.stat().st_size - images) / count / 1e3


def _embedding(overrides: Sequence[str], folder: Path) -> list[tuple[str, bool]]:
    dataset: Any = graph_of_words(overrides).stages["dataset"].plugin
    frames = [frame for i in range(min(60, len(dataset))) if isinstance(frame := dataset(i), Frame)]
    began, cpu = time.perf_counter(), time.process_time()
    writer = RecordingWriter(folder / "frames.mcap", {})
    for frame in frames:
        writer.write("dataset", frame)
    writer.close()
    cpu_ms = 1e3 * (time.process_time() - cpu) / len(frames)
    rate, size = len(frames) / (time.perf_counter() - began), (folder / "frames.mcap").stat().st_size / len(frames) / 1e3
    sizes = f"of {frames[0].camera.width} × {frames[0].camera.height}, {size:.0f} kB and {cpu_ms:.1f} ms CPU each"
    text = f"{rate:.0f} embedded frames/s {sizes}, at least {LEAST_FRAMES_S:.0f}"
    return [(text, rate >= LEAST_FRAMES_S)]


def _reading(folder: Path, count: int) -> list[tuple[str, bool]]:
    source, path = Recording(folder / "run.mcap"), folder / "long.mcap"
    values: dict[int, list[tuple[str, Value]]] = {}
    for topic in [FRAMES_TOPIC, *sorted(source.topics - {FRAMES_TOPIC})]:
        for value in source.values(topic):
            values.setdefault(value.index, []).append((topic, value))
    of_frame = [values[index] for index in sorted(values)]
    writer = RecordingWriter(path, {"overrides": "[]"})
    for index in range(count):
        for topic, value in of_frame[index % len(of_frame)]:
            writer.write(topic, replace(value, index=index, stamp_ns=33_333_333 * index))
    writer.close()
    begin = count * 2 // 3 // len(of_frame) * len(of_frame)
    longest, topics = 0.0, 0
    for frame in np.linspace(begin, min(begin + len(of_frame), count) - 1, 10).astype(int).tolist():
        seconds, topics = min(_time_to_open(path, frame) for _ in range(3))
        longest = max(longest, seconds)
    size = path.stat().st_size / 1e6
    text = f"{count} frames, {size:.0f} MB: opened and the {topics} topics of one frame read in {longest:.3f} s, under {MOST_OPEN_S} s"
    return [(text, longest < MOST_OPEN_S and topics > 1)]


def _time_to_open(path: Path, frame: int) -> tuple[float, int]:
    """Seconds for opening a recording and reading a frame, and the number of its topics."""
    began = time.perf_counter()
    topics = len(Recording(path).frame(frame))
    return time.perf_counter() - began, topics


def graph_of_words(overrides: Sequence[str]) -> Graph:
    """The graph that `trihedron run` would make of these overrides."""
    from trihedron.pipeline.core.config import compose_run, graph_of

    return graph_of(compose_run(overrides))
