"""Growth of time and memory with threads, image size, number of features, size of the map and length of the walk, in the built-in rooms.

Each row is a run in a process of its own. A frame's time is that of its stages, one after another, without the rendering of the frame (median over
the frames); the throughput contains it. Memory is the most that the run held at one of these frames, with the textures that are rendered. Further
overrides hold for all runs. The reference workload is that of `trihedron benchmark`, on images of the row.

threads, image and features are the built-in room; length is it in 320×240 unless overridden, as long walks take long. map is the walk through ten
rooms, always measured on the same 100 frames, in rooms not seen before: a row begins so many frames earlier, so that its map holds more. Besides all
stages it shows those that read the map: medians, and of those that work at keyframes the 95th percentile.

Example: trihedron benchmark scaling --png scaling.png --json scaling.json
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.app.recorded_values import last_map
from trihedron.pipeline.core.errors import DataError, UsageError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import Map
from trihedron.pipeline.record.codec import TIMING_TOPIC, timing_of
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.arguments import Parser
from trihedron.tools.benchmark import machine, measure, reference_ms, sample_images
from trihedron.tools.benchmarks.map_benchmark import FEATURES
from trihedron.tools.benchmarks.scaling_plot import plot

FIRST, STOP = 2200, 2300  # frames of the walk through ten rooms that are measured beside maps of several sizes
PARTS: dict[str, dict[str, list[str]]] = {  # part -> what a row is called -> its overrides
    "threads": {str(n): [f"threads={n}"] for n in (1, 2, 4, 8) if n <= (os.cpu_count() or 1)},
    "image": {f"{w}x{3 * w // 4}": [f"dataset.width={w}", f"dataset.height={3 * w // 4}"] for w in (320, 640, 960, 1280)},
    "features": {str(n): [f"keypoints.features={n}"] for n in (250, 500, 1000, 2000)},
    "map": {str(n): [f"dataset.length={STOP}", f"dataset.frames={FIRST - n}:{STOP}"] for n in (50, 250, 900, 2200)},
    "length": {str(n): [f"dataset.length={n}"] for n in (100, 1000, 5000)},
}
OF_PART = {"map": ["dataset.scene=rooms"], "length": ["dataset.width=320", "dataset.height=240"]}  # of all its rows, unless given otherwise
LABELS = {"threads": "threads", "image": "image size", "features": "key points", "map": "walked before", "length": "frames"}
AT_KEYFRAMES = ("map", "bundle", "loop")
READERS = ("matches", "pose", *AT_KEYFRAMES)  # stages that read the map
FROM_JSON = "give files written by trihedron benchmark scaling --json"
Rows = list[dict[str, Any]]


def main(argv: list[str]) -> int:
    """Run the parts, or read them, and print a table of each. Raises UsageError for an unknown part, TrihedronError when a run fails."""
    parser = Parser("benchmark scaling", __name__)
    parser.add_argument("overrides", nargs="*", help="of every run, as for trihedron run")
    parser.add_parts(PARTS)
    parser.add_argument("--lengths", default="", metavar="N,N", help="of the walk, in frames (default: 100,1000,5000)")
    parser.add_argument("--png", type=Path, metavar="FILE", help="plot the tables")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too, after each part")
    parser.add_argument(
        "--draw",
        type=Path,
        nargs="+",
        metavar="FILE.json",
        help="read such files instead of measuring; of two the later counts",
    )
    options = parser.parse(argv)
    _folders(options.json, options.png)
    figures: dict[str, Any] = {"machine": machine()}
    if options.draw:
        figures = read(options.draw)
        print("\n\n".join(report(part, figures[part]) for part in options.parts if part in figures))
        _write(figures, options.json)
    else:
        for part, rows in {part: _rows(part, options.lengths) for part in options.parts}.items():
            words = [*OF_PART.get(part, []), *options.overrides]
            figures[part] = [_measure_run(part, name, [*words, *overrides]) for name, overrides in rows.items()]
            print(report(part, figures[part]) + "\n", flush=True)
            _write(figures, options.json)
    if options.png:
        plot({part: figures[part] for part in options.parts if part in figures}, options.png)
    return 0


def _folders(*files: Path | None) -> None:
    """Raise UsageError for a file whose folder does not exist: it would be known after all runs only."""
    for file in files:
        if file is not None and not file.absolute().parent.is_dir():
            raise UsageError("benchmark scaling", f"the folder {file.absolute().parent} does not exist", "make it first")


def _write(figures: Mapping[str, Any], path: Path | None) -> None:
    if path is not None:
        write_file(path, json.dumps(figures, indent=2) + "\n")


def _rows(part: str, lengths: str) -> dict[str, list[str]]:
    if part != "length" or not lengths:
        return PARTS[part]
    if not all(word.isdigit() and int(word) > 0 for word in lengths.split(",")):
        raise UsageError("benchmark scaling", f"--lengths '{lengths}' is not a list of numbers of frames", "write 100,1000,5000")
    return {word: [f"dataset.length={word}"] for word in lengths.split(",")}


def _measure_run(part: str, name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """One run: ms of a frame's stages, throughput, size of the map, memory and error."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        run = measure([*overrides, f"out={out}"], out)
        recording = Recording(out / "run.mcap")
        timing = [timing_of(data) for _, data in recording.messages(TIMING_TOPIC)]
        map = last_map(recording)
    if part == "map":
        timing, overrides = timing[FIRST - STOP :], [*overrides, f"dataset.frames={FIRST}:{STOP}"]
    return {
        "name": name, "frames": run["frames"], **measures(timing), "reference_ms": reference_ms(sample_images(list(overrides))),
        "fps": run["fps"], "points": _living(map), "ate_m": run.get("metrics", {}).get("final", {}).get("ate_rmse_m"),
    }  # fmt: skip


def _living(map: Map | None) -> int:
    return int(np.count_nonzero(map.points.column("alive"))) if map is not None else 0


def measures(timing: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Measures of some frames' messages: the most memory, and medians of all stages but the data set, of those after the features, and of each
    reader."""
    stages = [{name: ms for name, ms in row["stage_ms"].items() if name != "dataset"} for row in timing]
    every = [sum(row.values()) for row in stages]
    after = [sum(ms for name, ms in row.items() if name not in FEATURES) for row in stages]
    calls = {name: [row[name] for row in stages if name in row] for name in READERS}
    return {
        "memory_mb": max(row["memory_mb"] for row in timing), "frame_ms": _percentile(every, 50), "after_features_ms": _percentile(after, 50),
        "readers_ms": {name: _percentile(ms, 95 if name in AT_KEYFRAMES else 50) for name, ms in calls.items() if ms},
    }  # fmt: skip


def _percentile(ms: Sequence[float], share: float) -> float:
    return round(float(np.percentile(ms, share)), 2)


def read(paths: Sequence[Path]) -> dict[str, Any]:
    """The figures of several files; a part that stands in two is the later file's. Raises DataError for one that is not of this command."""
    figures: dict[str, Any] = {}
    for path in paths:
        try:
            found = json.loads(path.read_text())
            if not [report(part, found[part]) for part in PARTS if part in found]:
                raise ValueError("no part")
        except OSError as error:
            raise DataError(str(path), f"cannot be read ({error.strerror})", FROM_JSON) from error
        except (ValueError, KeyError, TypeError, ZeroDivisionError) as error:
            raise DataError(str(path), "holds no figures of benchmark scaling", FROM_JSON) from error
        figures |= found
    return figures


def report(part: str, rows: Rows) -> str:
    """The table of a part; of the map's also the stages that read it."""
    readers = [name for name in READERS if part == "map" and any(name in row["readers_ms"] for row in rows)]
    named = [f"{name} p95" if name in AT_KEYFRAMES else name for name in readers]
    cells: list[tuple[str, ...]] = [
        (LABELS[part], "map points", "stages ms", "after features", *named, "x reference", "frames/s", "memory MB", "ATE mm")
    ]
    for row in rows:
        ate = f"{1e3 * row['ate_m']:.2f}" if row["ate_m"] is not None else ""
        each = [f"{row['readers_ms'][name]:.1f}" if name in row["readers_ms"] else "" for name in readers]
        own = f"{row['frame_ms']:.1f}", f"{row['after_features_ms']:.1f}", *each, f"{row['frame_ms'] / row['reference_ms']:.2f}"
        cells.append((row["name"], str(row["points"]), *own, f"{row['fps']:.1f}", f"{row['memory_mb']:.0f}", ate))
    return table(cells, "r" * len(cells[0]))
