"""Compare every surface on one run of the noisy synthetic room, furnished with a column, a ball and a plant, at the poses that were estimated.

The room is tracked once; then each surface gathers the recorded frames, planes and poses by itself, one thread. Accuracy is the mean distance of
the mesh from the true surface, by its nearer part, planar or curved; completeness the share of the true surface that was seen which is within 5 cm
of the mesh (`trihedron evaluate-surface` explains). Times: a frame (half of them take less, and 95 %), and the final mesh. Views are what a surface
remembers.

Example: trihedron benchmark surface --frames 500 --json surfaces.json
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import UsageError, did_you_mean
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.registry import load_plugins, plugin_class, plugins_of
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import Map, Surface
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.arguments import Parser

SCENE = ("dataset=synthetic", "dataset.curved=true")
MESHES = 2  # the faster one counts: other programs slow down the other
WARM_UP = 3  # frames and a mesh before the clock starts: kernels are loaded by then
HEADER = ["surface", "triangles", "kB", "planar cm", "< 5 cm", "curved cm", "< 5 cm", "all cm", "< 5 cm", "p50 ms", "p95 ms", "mesh s", "views", "MB"]


def main(argv: list[str]) -> int:
    """Print the table; returns the exit code. Raises UsageError for an unknown surface or a number out of range."""
    parser = Parser("benchmark surface", __name__)
    parser.add_argument("--frames", type=int, default=500, metavar="N", help="of the walk through the room (default: 500)")
    parser.add_argument("--surfaces", default="", metavar="A,B", help="some of them (default: all that are registered)")
    parser.add_argument("--run", type=Path, metavar="FOLDER", help="a run of this room with record.frames=true, instead of a new one")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    options = parser.parse(argv)
    if not 10 <= options.frames <= 100_000:
        raise UsageError("benchmark surface", f"--frames {options.frames} is out of range", "give 10 to 100000")
    load_plugins()
    known = [name for name in plugins_of("surface") if name != "none"]
    names = [name for name in options.surfaces.split(",") if name] or known
    for name in names:
        if name not in known:
            raise UsageError("benchmark surface", f"there is no surface '{name}'", did_you_mean(name, known))
    with tempfile.TemporaryDirectory() as folder:
        run = options.run or track_room(Path(folder) / "run", options.frames)
        figures = measure_surfaces(run, names)
    print(report(figures))
    if options.json:
        write_file(options.json, json.dumps(figures, indent=2) + "\n")
    return 0


def track_room(out: Path, frames: int) -> Path:
    """Track the room in a process of its own, which ends with the default surface. Returns the run folder."""
    from trihedron.tools.benchmark import measure

    timing = measure([*SCENE, f"dataset.length={frames}", "outputs=[trajectory,surface]", "record.frames=true", f"out={out}"], out)
    stage = timing["stages"]["surface"]
    print(f"tracked: ATE {timing['metrics']['final']['ate_rmse_m']:.4f} m; beside it planar_tsdf took {stage['p50_ms']:.1f} ms a frame (p50)")
    return out


def measure_surfaces(run: Path, names: list[str]) -> dict[str, Any]:
    """The figures of each surface over the recording of a run."""
    from trihedron.comparison.surface_errors import alignment_and_truth, mesh_errors
    from trihedron.pipeline.run.scheduler import single_threaded_libraries

    recording = Recording(run / "run.mcap")
    inputs = {topic: {value.index: value for value in recording.values(topic)} for topic in ("planes", "rotation", "pose", "map")}
    dataset = plugin_class("dataset", "mcap")(path=str(recording.path))
    maps = [value for _, value in sorted(inputs["map"].items()) if isinstance(value, Map)]
    folds = {name: _Fold(plugin_class("surface", name)()) for name in names}
    with single_threaded_libraries():
        for fold in folds.values():
            fold.warm_up([dataset(position) for position in range(WARM_UP)], inputs)
        for position in range(len(dataset)):
            frame = dataset(position)
            for fold in folds.values():
                fold.add(frame, inputs)
        for fold in folds.values():
            fold.finish(maps[-1] if maps else None)
    T, truth = alignment_and_truth(run / "trajectory.txt", recording.path)
    found = {}
    for name, fold in folds.items():
        vertices = fold.surface.vertices_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        found[name] = {**mesh_errors(vertices, fold.surface.triangles, truth), **fold.cost()}
    return {"frames": len(dataset), "surfaces": found}


class _Fold:
    """One surface and what it costs."""

    def __init__(self, plugin: Any) -> None:
        self.plugin, self.state, self.ms, self.mesh_s = plugin, plugin.start(), list[float](), 0.0
        self.surface = Surface.empty(0, 0)

    def warm_up(self, frames: list[Any], inputs: dict[str, Any]) -> None:
        for frame in frames:
            self.add(frame, inputs)
        self.finish(None)
        self.state, self.ms = self.plugin.start(), []

    def add(self, frame: Any, inputs: dict[str, Any]) -> None:
        given = [inputs[topic].get(frame.index) for topic in ("planes", "rotation", "pose", "map")]
        began = time.perf_counter()
        self.state = self.plugin.add(self.state, frame, *given)
        self.ms.append(1e3 * (time.perf_counter() - began))

    def finish(self, map: Map | None) -> None:
        self.mesh_s = float("inf")
        for _ in range(MESHES):
            began = time.perf_counter()
            self.surface = self.plugin.finish(self.state, map)
            self.mesh_s = min(self.mesh_s, time.perf_counter() - began)

    def cost(self) -> dict[str, Any]:
        """Times, size and memory."""
        from trihedron.plugins.surface.ply import triangle_planes, write_ply

        with tempfile.TemporaryDirectory() as folder:
            path, surface = Path(folder) / "surface.ply", self.surface
            write_ply(path, surface.vertices_m, surface.colors, surface.triangles, triangle_planes(surface), "")
            size = path.stat().st_size
        views = self.state.views
        kept = sum(view.depth_m.nbytes + view.color.nbytes + view.labels.nbytes for view in views)
        half, high = np.percentile(self.ms, [50, 95])
        return {"bytes": size, "p50_ms": float(half), "p95_ms": float(high), "mesh_s": self.mesh_s, "views": len(views), "view_bytes": kept}


def report(figures: dict[str, Any]) -> str:
    """The figures as a table."""
    rows = [HEADER]
    for name, found in figures["surfaces"].items():
        parts = [found["parts"][part] for part in ("planar", "curved", "all")]
        cells = [cell for part in parts for cell in (_or_dash(part["mean_m"], 1e2, "{:.2f}"), _or_dash(part["within_5_cm"], 1.0, "{:.1%}"))]
        times = [f"{found['p50_ms']:.1f}", f"{found['p95_ms']:.1f}", f"{found['mesh_s']:.2f}"]
        rows.append([name, found["triangles"], f"{found['bytes'] / 1e3:.0f}", *cells, *times, found["views"], f"{found['view_bytes'] / 1e6:.0f}"])
    return f"{figures['frames']} frames\n" + table(rows, "l" + "r" * (len(HEADER) - 1))


def _or_dash(value: float | None, factor: float, form: str) -> str:
    return "-" if value is None else form.format(value * factor)
