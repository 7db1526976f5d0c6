"""Attribute a run's error to its stages: rerun it with the output of one stage replaced by the truth, and see what remains.

Each row replays the recording: the stages it names are true, every stage that depends on them is computed again, everything else is as recorded.

- `nothing`: the run again, as it was.
- `rotation`, `translation`: the rotation, the position of the decoupled pose is the ground truth's; tracking and mapping start from it.
- `map`: keyframes have their true poses, and landmarks move with the keyframes that observed them (`true_map`). The rows of the map, what it holds
  when, and the noise of its measurements are as recorded. The poses are found in it anew.

What disappears with a row is the error that enters through that stage; what remains with all of them is that of the refinement on single frames.

Example: trihedron error-budget runs/a/run.mcap
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.app.recorded_run import composed_run
from trihedron.pipeline.core.config import graph_of
from trihedron.pipeline.core.errors import DataError, StageError
from trihedron.pipeline.core.geometry import nearest_pairs, nearest_rotation
from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.core.types import F64, Map, Pose, Rotation, Translation, Value
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.metrics import MAX_DIFFERENCE_NS
from trihedron.pipeline.sweep.search import followers
from trihedron.tools.arguments import Parser, table
from trihedron.tools.true_map import true_map

EXACT = 1e-12  # variance of what is true, m² and rad²; positive, so that it can be inverted
ROWS = ((), ("rotation",), ("translation",), ("rotation", "translation"), ("map",), ("rotation", "translation", "map"))


@dataclass(frozen=True)
class Truth:
    """True poses (4, 4) in the world of the run, by frame stamp."""

    poses: dict[int, F64]

    def rotation(self, value: Value) -> Value:
        """The frame's Rotation as it should have been."""
        T = self.poses.get(value.stamp_ns)
        if not isinstance(value, Rotation) or T is None:
            return value
        return replace(value, R_world_camera=T[:3, :3].copy(), covariance=EXACT * np.eye(3))

    def translation(self, value: Value) -> Value:
        """The frame's Translation as it should have been."""
        T = self.poses.get(value.stamp_ns)
        if not isinstance(value, Translation) or T is None:
            return value
        return replace(value, t_world_camera=T[:3, 3].copy(), covariance=EXACT * np.eye(3), unobservable=np.empty((0, 3)), estimated=True)

    def map(self, value: Value) -> Value:
        """The Map as it should have been, with the same rows."""
        return true_map(value, self.poses) if isinstance(value, Map) else value


def main(argv: list[str]) -> int:
    """Print the table; returns the exit code. Raises DataError for a recording without poses or truth, StageError when a replay fails."""
    parser = Parser("error-budget", __name__)
    parser.add_argument("recording", metavar="RUN.mcap", type=Path, help="of a run whose data set has ground truth")
    found = budget(Recording(parser.parse_args(argv).recording))
    rows: list[list[str]] = [["true", "ATE RMSE (m)", "× whole", "RPE over 1 s (m)", "(deg)"]]
    whole = found[()]["ate_rmse_m"]
    for stages, metrics in found.items():
        errors = [f"{metrics[key]:.4f}" if metrics[key] is not None else "-" for key in ("rpe_second_rmse_m", "rpe_second_rmse_deg")]
        rows.append([" + ".join(stages) or "nothing", f"{metrics['ate_rmse_m']:.4f}", f"{metrics['ate_rmse_m'] / whole:.2f}", *errors])
    print(table(rows, "lrrrr"))
    return 0


def budget(recording: Recording) -> dict[tuple[str, ...], dict[str, Any]]:
    """Return the final metrics with each row of stages replaced by the truth, beginning with none. Raises DataError, StageError."""
    truth = true_poses(recording)
    with tempfile.TemporaryDirectory() as folder:
        return {stages: rerun(recording, truth, stages, Path(folder)) for stages in ROWS if recording.topics.issuperset(stages)}


def true_poses(recording: Recording) -> Truth:
    """The attached ground truth at the run's frames, moved into the run's world by the mean of what lies between the two.

    Raises DataError without poses or ground truth."""
    truth = attached_truth(recording.attachments, str(recording.path))
    poses = [value for value in recording.values("pose") if isinstance(value, Pose)] if "pose" in recording.topics else []
    pairs = nearest_pairs(np.array([pose.stamp_ns for pose in poses], np.int64), truth.stamps_ns, MAX_DIFFERENCE_NS) if truth else np.empty((0, 2))
    if truth is None or len(pairs) < 2:
        raise DataError(str(recording.path), "holds no poses with ground truth", "record a run of a data set that has it")
    estimate, true = np.array([poses[row].T_world_camera for row, _ in pairs]), truth.poses[pairs[:, 1]]
    T = np.eye(4)
    T[:3, :3] = nearest_rotation((estimate[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)).mean(axis=0))
    T[:3, 3] = (estimate[:, :3, 3] - true[:, :3, 3] @ T[:3, :3].T).mean(axis=0)
    return Truth({poses[row].stamp_ns: T @ pose for (row, _), pose in zip(pairs, true)})


def rerun(recording: Recording, truth: Truth, stages: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """Final metrics of a replay in which the topics of `stages` are true."""
    source = folder / "source.mcap"
    rewrite(recording, source, {name: getattr(truth, name) for name in stages})
    return replayed(source, recomputed(recording, stages), folder / "run")


def recomputed(recording: Recording, stages: tuple[str, ...]) -> tuple[str, ...]:
    """Return the recorded stages that depend on one of these, over any number of wires, without these; of none, those of the first row."""
    graph = graph_of(composed_run(recording))
    first = [stage for stage in stages or ("rotation",) if stage in graph.stages]
    found = needed_for_pose(graph, frozenset(stages))
    return tuple(stage for stage in followers(graph, first) if stage not in stages and stage in found & recording.topics)


def needed_for_pose(graph: Graph, given: frozenset[str]) -> frozenset[str]:
    """Return the stages from which the pose is computed, over any number of wires, when those `given` are not computed."""
    found: set[str] = set()
    pending = ["pose", "map"]
    while pending:
        name = pending.pop()
        if name in graph.stages and name not in found and name not in given:
            found.add(name)
            pending += [wire.topic for wire in graph.stages[name].inputs.values()]
    return frozenset(found)


def rewrite(recording: Recording, path: Path, changed: Mapping[str, Callable[[Value], Value]]) -> None:
    """Copy the recording's topics, those in `changed` through the function given there."""
    writer = RecordingWriter(path, {name: text for name, text in recording.metadata.items() if name != "format"})
    for name, text in recording.attachments.items():
        writer.attach(name, text)
    for topic in sorted(recording.topics):
        for value in map(changed.get(topic, lambda value: value), recording.values(topic)):
            writer.write(topic, value)
    writer.close()


def replayed(source: Path, stages: tuple[str, ...], out: Path) -> dict[str, Any]:
    """Run the stages again over the recording; the final metrics."""
    from trihedron.pipeline.app.cli import main as trihedron

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        code = trihedron(["run", f"replay={source}", f"only=[{','.join(stages)}]", f"out={out}"])
    if code:
        raise StageError(f"replay of {', '.join(stages)}", (printed.getvalue().strip().splitlines() or ["failed"])[-1], "run it alone to see more")
    metrics: dict[str, Any] = json.loads((out / "metrics.json").read_text())["final"]
    return metrics
