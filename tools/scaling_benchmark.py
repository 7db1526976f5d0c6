"""How time and memory grow with threads, image size, number of features, size of the map and length of the walk, on the built-in room.

Each row is a run of its own. A frame's time is that of its stages, one after another, without the rendering of the frame; the throughput contains
it. Everything else is as by default, and further overrides hold for all runs; for the map, 150 frames go on from the map that so many frames have
made. The reference workload is that of `trihedron benchmark`, on images of the row's size.

Example: trihedron benchmark scaling --parts threads,image --png scaling.png --json scaling.json
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trihedron.pipeline.errors import DataError, UsageError
from trihedron.tools.arguments import Parser, table
from trihedron.tools.benchmark import first_images, machine, measure, memory_text, reference_ms

PARTS: dict[str, dict[str, list[str]]] = {  # part -> what a row is called -> its overrides
    "threads": {str(n): [f"threads={n}"] for n in (1, 2, 4, 8) if n <= (os.cpu_count() or 1)},
    "image": {f"{w}x{3 * w // 4}": [f"dataset.width={w}", f"dataset.height={3 * w // 4}"] for w in (320, 640, 960, 1280)},
    "features": {str(n): [f"keypoints.features={n}"] for n in (250, 500, 1000, 2000)},
    "map": {str(n): [f"dataset.length={n}"] for n in (150, 600, 2400)},  # of the run that makes the map
    "length": {str(n): [f"dataset.length={n}"] for n in (100, 300, 1000)},
}
LABELS = {"threads": "threads", "image": "image size", "features": "key points", "map": "frames mapped", "length": "frames"}
GOING_ON = "dataset.length=150"  # what is measured with a map
Rows = list[dict[str, Any]]


def main(argv: list[str]) -> int:
    """Run the parts and print a table of each. Raises UsageError for an unknown part, TrihedronError when a run fails."""
    parser = Parser("benchmark scaling", __name__)
    parser.add_argument("overrides", nargs="*", help="of every run, as for trihedron run")
    parser.add_parts(PARTS)
    parser.add_argument("--lengths", default="", metavar="N,N", help="of the walk, in frames (default: 100,300,1000)")
    parser.add_argument("--png", type=Path, metavar="FILE", help="plot the tables")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    options = parser.parse_args(argv)
    parts = {part: _rows(part, options.lengths) for part in options.parts}
    figures: dict[str, Any] = {"machine": machine()}
    for part, rows in parts.items():
        figures[part] = [(_with_map if part == "map" else _measured)(name, [*options.overrides, *overrides]) for name, overrides in rows.items()]
        print(report(part, figures[part]) + "\n", flush=True)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    if options.png:
        plot({part: figures[part] for part in parts}, options.png)
    return 0


def _rows(part: str, lengths: str) -> dict[str, list[str]]:
    if part != "length" or not lengths:
        return PARTS[part]
    if not all(word.isdigit() and int(word) > 0 for word in lengths.split(",")):
        raise UsageError("benchmark scaling", f"--lengths '{lengths}' is not a list of numbers of frames", "write 100,1000,5000")
    return {word: [f"dataset.length={word}"] for word in lengths.split(",")}


def _with_map(name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """Two runs: one that makes a map, and the one measured, which goes on in it."""
    with tempfile.TemporaryDirectory() as folder:
        out, map = Path(folder) / "run", Path(folder) / "map.mcap"
        measure([*overrides, "record.topics=[]", f"save_map={map}", f"out={out}"], out)
        return _measured(name, [*overrides, GOING_ON, f"load_map={map}"])


def _measured(name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """One run: ms of a frame's stages, throughput, CPU and memory."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        run = measure([*overrides, "record.topics=[]", f"out={out}"], out)
    stages = sum(stage["p50_ms"] for stage_name, stage in run["stages"].items() if stage_name != "dataset")
    reference = reference_ms(first_images(list(overrides)))
    return {
        "name": name, "frames": run["frames"], "frame_ms": round(stages, 2), "reference_ms": reference, "fps": run["fps"],
        "peak_memory_mb": run["peak_memory_mb"], "ate_m": run.get("metrics", {}).get("final", {}).get("ate_rmse_m"),
    }  # fmt: skip


def report(part: str, rows: Rows) -> str:
    """The table of a part."""
    cells: list[tuple[str, ...]] = [(LABELS[part], "stages ms", "x reference", "frames/s", "memory MB", "ATE mm")]
    for row in rows:
        ate = f"{1e3 * row['ate_m']:.2f}" if row["ate_m"] is not None else ""
        multiple = f"{row['frame_ms'] / row['reference_ms']:.2f}"
        cells.append((row["name"], f"{row['frame_ms']:.1f}", multiple, f"{row['fps']:.1f}", memory_text(row), ate))
    return table(cells, "rrrrrr")


def plot(parts: dict[str, Rows], path: Path) -> None:
    """A PNG with one field a part: time of a frame's stages, and peak memory. Raises DataError when it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4 * len(parts), 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (part, rows) in zip(figure.subplots(1, len(parts), squeeze=False)[0], parts.items()):
        names = [row["name"] for row in rows]
        axes.plot(names, [row["frame_ms"] for row in rows], "o-", color="tab:blue")
        axes.set(xlabel=LABELS[part], ylabel="a frame's stages, ms")
        axes.set_ylim(bottom=0.0)
        memory = axes.twinx()
        memory.plot(names, [row["peak_memory_mb"] for row in rows], "s--", color="tab:orange")
        memory.set_ylabel("peak memory, MB", color="tab:orange")
        memory.set_ylim(bottom=0.0)
    try:
        figure.savefig(path, dpi=100)
    except OSError as error:
        raise DataError(str(path), f"cannot be written ({error.strerror})", "give a file in a folder that exists") from error
