"""Judge the plans of the synthetic buildings by the exact ones.

Each scene is tracked with several seeds (of textures, path and noise) and the depth noise of two cameras, and its plan is moved by the SE(3) that
aligns trajectory.txt with the truth, never by itself. A room is found where the intersection over union with a true one is above 0.5. Walls are the
edges of found rooms that lie on a face that was seen, position the distance of their middle from the true edge. A doorway is found within 0.3 m of
its middle. "honest" is the share of errors of areas, wall offsets and storey heights within 1.96 of their standard deviations. Figures are medians
over the seeds, "honest" a mean. slanted_flat is laid out by atlanta_layout; the seed of random_flat and glazed_flat is the number of the flat, too. A
second table has the measure of methods that are judged on Structured3D: rooms, corners and angles, and "area in 95 %", the share of rooms with an
area in its interval; means over the runs with 95 % intervals (Student's t), and "false" the openings of all runs that are none. A benchmark with
--out that was stopped goes on where it was. With --true-poses nothing is tracked: keyframes of the walk at their true poses show what the plan alone
gets wrong.

Example: trihedron benchmark building --scenes offices --seeds 2
"""

from __future__ import annotations

import json
import shutil
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from trihedron.comparison.building_errors import plan_errors, plan_errors_of_run
from trihedron.datasets.simulation.synthetic import FLATS, Scene, Sensor, Synthetic
from trihedron.pipeline.core.errors import UsageError, did_you_mean
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.registry import load_plugins, plugin_class
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import Pose
from trihedron.pipeline.sweep.paired_statistics import half_interval
from trihedron.plugins.building.views import has_moved
from trihedron.tools.arguments import Parser

SCENES = ("offices", "rooms", "corridor", "flat", "slanted_flat", "house")
NUMBERED = tuple(scene.name for scene in FLATS)
MORE = (*NUMBERED, "whole_floor")  # on demand
LAYOUTS = {"slanted_flat": "atlanta_layout"}  # of the slot building; the other scenes have the graph's own
SENSORS = ("kinect", "stereo")
WIDTH, HEIGHT = 320, 240
SIGMA = 1e-3  # m, rad, that true poses state
HEADER = [
    "scene", "sensor", "runs", "wall cm", "angle °", "IoU", "recall", "precision", "doors", "precision", "area %", "height cm", "honest", "frame ms",
    "final s",
]  # fmt: skip
PUBLISHED_HEADER = [
    "scene", "sensor", "runs", "room P", "room R", "room F1", "corner P", "corner R", "corner F1", "angle F1", "area in 95 %", "false",
]  # fmt: skip


def main(argv: list[str]) -> int:
    """Print the table; returns the exit code. Raises UsageError for an unknown scene or plugin, DataError for a run without a plan."""
    parser = Parser("benchmark building", __name__)
    parser.add_argument("--scenes", default=",".join(SCENES), metavar="A,B", help=f"some of them, or {', '.join(MORE)} (default: {','.join(SCENES)})")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="runs of each scene (default: 5)")
    parser.add_argument("--first-seed", type=int, default=0, metavar="N", help="seed of the first (default: 0)")
    parser.add_argument("--sensors", default=",".join(SENSORS), metavar="A,B", help=f"of the depth noise (default: {','.join(SENSORS)})")
    parser.add_argument(
        "--plugin", default="", metavar="NAME", help="of the slot building (default: atlanta_layout for slanted_flat, else the graph's own)"
    )
    parser.add_argument("--fps", type=float, default=15.0, metavar="HZ", help="frames a second of the walks (default: 15)")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="keep the runs here; one that is there already is judged as it is")
    parser.add_argument("--anew", action="store_true", help="make the plans of runs anew from what they recorded; final s is then CPU time")
    parser.add_argument("--true-poses", action="store_true", help="track nothing: make the plans at the true poses of the walk")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures of each run too")
    options = parser.parse(argv)
    if not 1 <= options.seeds <= 100:
        raise UsageError("benchmark building", f"--seeds {options.seeds} is out of range", "give 1 to 100")
    if options.first_seed < 0:
        raise UsageError("benchmark building", f"--first-seed {options.first_seed} is negative", "give 0 or more")
    if not 1.0 <= options.fps <= 60.0:
        raise UsageError("benchmark building", f"--fps {options.fps:g} is out of range", "give 1 to 60")
    scenes, sensors = _split_names("scene", options.scenes, (*SCENES, *MORE)), _split_names("sensor", options.sensors, SENSORS)
    found: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for scene in scenes:
            for sensor in sensors:
                runs = {
                    seed: (options.out or Path(folder)) / f"{scene}.{sensor}.{seed}"
                    for seed in range(options.first_seed, options.first_seed + options.seeds)
                }
                found[f"{scene} {sensor}"] = [
                    figures_at_true_poses(scene, sensor, seed, options.fps, options.plugin)
                    if options.true_poses
                    else _figures(_track_scene(scene, sensor, seed, options.fps, run), options.plugin, options.anew)
                    for seed, run in runs.items()
                ]
    print(f"{report(found)}\n\n{published_measure(found)}")
    if options.json:
        write_file(options.json, json.dumps(found, indent=2) + "\n")
    return 0


def _split_names(kind: str, names: str, known: tuple[str, ...]) -> list[str]:
    """Return the names of a list with commas. Raises UsageError for an unknown one."""
    listed = [name for name in names.split(",") if name]
    for name in listed:
        if name not in known:
            raise UsageError("benchmark building", f"there is no {kind} '{name}'", did_you_mean(name, list(known)))
    return listed


def _track_scene(scene: str, sensor: str, seed: int, fps: float, out: Path) -> Path:
    """Return the folder of one run, tracked in a process of its own unless it is there. A run that was stopped is begun again."""
    from trihedron.tools.benchmark import measure

    if not (out / "timing.json").exists():
        unfinished = out.with_name(out.name + ".unfinished")
        shutil.rmtree(unfinished, ignore_errors=True)
        words = ["dataset=synthetic", f"dataset.scene={scene}", f"dataset.sensor={sensor}", f"dataset.seed={seed}", f"dataset.width={WIDTH}"]
        words += [f"building={LAYOUTS[scene]}"] if scene in LAYOUTS else []
        words += [f"dataset.flat={seed}"] if scene in NUMBERED else []
        measure([*words, f"dataset.height={HEIGHT}", f"dataset.fps={fps:g}", "outputs=[trajectory,building]", f"out={unfinished}"], unfinished)
        unfinished.rename(out)
    return out


def _figures(run: Path, plugin: str, anew: bool) -> dict[str, float]:
    """Return the figures of a run folder: of its plan as recorded, or made anew by a plugin or by its own."""
    stage = json.loads((run / "timing.json").read_text())["stages"]["building"]
    own = _layout_of(run.name.split(".")[0])
    figures = {"final_s": stage["finish_ms"] / 1e3} | plan_errors_of_run(run, plugin or (own if anew else None))
    return figures if plugin else figures | {"frame_ms": stage["p50_ms"]}


def _layout_of(scene: str) -> str:
    return LAYOUTS.get(scene, "manhattan_layout")


def figures_at_true_poses(scene: str, sensor: str, seed: int, fps: float, plugin: str) -> dict[str, float]:
    """Return the figures of the plan of keyframes at their true poses, with the CPU time of its completion."""
    load_plugins()
    dataset = Synthetic(
        scene=Scene[scene], sensor=Sensor[sensor], seed=seed, flat=seed if scene in NUMBERED else 0, fps=fps, width=WIDTH, height=HEIGHT
    )  # fmt: skip
    normals, planes = plugin_class("normals", "integral_image")(), plugin_class("planes", "connected_components")()
    fold = plugin_class("building", plugin or _layout_of(scene))()
    state, last = fold.start(), None
    for index in range(len(dataset)):
        T = dataset.true_pose(index)
        if (last is None or has_moved(last, T)) and (frame := dataset(index)) is not None:
            last = T
            pose = Pose(index, frame.stamp_ns, T, SIGMA**2 * np.eye(6), T, -1, np.zeros(3, np.int32), 0, "ok", "")
            state = fold.add(state, frame, planes(frame, normals(frame)), None, pose, None)
    began = time.process_time()
    building = fold.finish(state, None)
    return {"final_s": time.process_time() - began} | plan_errors(building, np.eye(4), dataset.plans())


def published_measure(found: dict[str, list[dict[str, float]]]) -> str:
    """Return the table of rooms, corners and angles: means over the runs of each scene and sensor, and their 95 % intervals from three runs on."""
    columns = ("room_precision", "room_recall", "room_f1", "corner_precision", "corner_recall", "corner_f1", "angle_f1", "area_within")
    rows, every = [PUBLISHED_HEADER], [run for runs in found.values() for run in runs]
    for scene, runs in {**found, "all -": every}.items():
        cells = []
        for name in columns:
            values = [run[name] for run in runs if np.isfinite(run.get(name, float("nan")))]
            half = half_interval(values) if len(values) > 2 else None
            cells.append((f"{statistics.mean(values):.3f}" if values else "-") + (f" ± {half:.3f}" if half is not None else ""))
        false = [run["false_openings"] for run in runs if "false_openings" in run]
        rows.append([*scene.split(), str(len(runs)), *cells, f"{sum(false):.0f}" if false else "-"])
    return table(rows, "llr" + "r" * (len(columns) + 1))


def report(found: dict[str, list[dict[str, float]]]) -> str:
    """Return the table over the runs of each scene and sensor."""
    columns = [("wall_m", 1e2, ".2f"), ("angle_deg", 1.0, ".3f"), ("iou", 1.0, ".4f"), ("room_recall", 1.0, ".2f"), ("room_precision", 1.0, ".2f"),
               ("door_recall", 1.0, ".2f"), ("door_precision", 1.0, ".2f"), ("area_error", 1e2, ".2f"), ("height_m", 1e2, ".2f"),
               ("honest", 1.0, ".0%"), ("frame_ms", 1.0, ".3f"), ("final_s", 1.0, ".2f")]  # fmt: skip
    rows, every = [HEADER], [run for runs in found.values() for run in runs]
    for scene, runs in {**found, "all -": every}.items():
        cells = []
        for name, factor, form in columns:
            values = [run[name] for run in runs if np.isfinite(run.get(name, float("nan")))]
            middle = statistics.mean if name == "honest" else statistics.median
            cells.append(format(factor * middle(values), form) if values else "-")
        rows.append([*scene.split(), str(len(runs)), *cells])
    return table(rows, "llr" + "r" * len(columns))
