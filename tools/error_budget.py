"""Say where a run's error comes from: rerun it with the output of one stage replaced by the truth, and see what remains.

Each row replays the recording from behind the replaced stage: `rotation` and `translation` are the decoupled pose, `map` is the map that the same
frames build from true poses. What disappears with a row is that stage's share of the error; what remains with all of them is the refinement's own.

Example: trihedron error-budget runs/a/run.mcap
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError, StageError
from trihedron.pipeline.core.geometry import nearest_pairs, nearest_rotation
from trihedron.pipeline.core.types import F64, OK, Pose, Rotation, Translation, Value
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.metrics import MAX_DIFFERENCE_NS
from trihedron.tools.arguments import Parser, table

EXACT = 1e-12  # variance of what is true, m² and rad²; positive, so that it can be inverted
ROWS = ((), ("rotation",), ("translation",), ("rotation", "translation"), ("map",), ("rotation", "translation", "map"))
LOOP = ("relocalise", "matches", "pose", "map", "bundle", "loop")  # corrections are of one map only: whoever changes it adjusts it again
AFTER = {"rotation": ("translation", *LOOP), "translation": LOOP, "map": ("relocalise", "matches", "pose")}


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

    def pose(self, value: Value) -> Value:
        """The frame's Pose as it should have been."""
        T = self.poses.get(value.stamp_ns)
        if not isinstance(value, Pose) or T is None:
            return value
        return replace(value, T_world_camera=T, covariance=EXACT * np.eye(6), T_reference_camera=T, reference=-1, status=OK)


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
    source, changed = folder / "source.mcap", {name: getattr(truth, name) for name in stages if name != "map"}
    if "map" in stages:
        rewrite(recording, source, {"pose": truth.pose})
        correctors = [stage for stage in ("bundle", "loop") if stage in recording.topics]
        replayed(source, ("map", *correctors), folder / "map", *(f"{stage}=none" for stage in correctors))
        changed["map"] = dict(enumerate(Recording(folder / "map" / "run.mcap").values("map")))
    rewrite(recording, source, changed)
    first = min(stages, key=list(AFTER).index, default="rotation")
    again = [stage for stage in AFTER[first] if stage not in stages and stage in recording.topics]
    return replayed(source, tuple(again), folder / "run")


def rewrite(recording: Recording, path: Path, changed: dict[str, Any]) -> None:
    """Copy the recording's topics, those in `changed` through the function given there, or replaced by the values given there."""
    writer = RecordingWriter(path, {name: text for name, text in recording.metadata.items() if name != "format"})
    for name, text in recording.attachments.items():
        writer.attach(name, text)
    for topic in sorted(recording.topics):
        change: Callable[[Value], Value] | dict[int, Value] = changed.get(topic, lambda value: value)
        for value in change.values() if isinstance(change, dict) else map(change, recording.values(topic)):
            writer.write(topic, value)
    writer.close()


def replayed(source: Path, stages: tuple[str, ...], out: Path, *overrides: str) -> dict[str, Any]:
    """Run the stages again over the recording, changed by `overrides`; the final metrics, empty when no pose is among them."""
    from trihedron.pipeline.app.cli import main as trihedron

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        code = trihedron(["run", f"replay={source}", f"only=[{','.join(stages)}]", f"out={out}", *overrides])
    if code:
        raise StageError(f"replay of {', '.join(stages)}", (printed.getvalue().strip().splitlines() or ["failed"])[-1], "run it alone to see more")
    metrics: dict[str, Any] = json.loads((out / "metrics.json").read_text())["final"] if "pose" in stages else {}
    return metrics
