"""Replays of a run with the truth in the place of stages, and what each changes in its error."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison.true_map import true_map
from trihedron.comparison.verdicts import TOO_SHORT, Column, Sample, verdicts_of
from trihedron.pipeline.app.recorded_run import composed_run
from trihedron.pipeline.core.config import graph_of
from trihedron.pipeline.core.errors import DataError, StageError
from trihedron.pipeline.core.geometry import nearest_pairs, nearest_rotation
from trihedron.pipeline.core.types import F64, Map, Pose, Rotation, Translation, Value
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth, read_trajectory
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.metrics import MAX_DIFFERENCE_NS, frame_errors
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.sweep.search import followers

ATE = "ate_rmse_m"
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
        return replace(value, R_world_camera=T[:3, :3].copy())

    def translation(self, value: Value) -> Value:
        """The frame's Translation as it should have been."""
        T = self.poses.get(value.stamp_ns)
        if not isinstance(value, Translation) or T is None:
            return value
        return replace(value, t_world_camera=T[:3, 3].copy(), unobservable=np.empty((0, 3)), estimated=True)

    def map(self, value: Value) -> Value:
        """The Map as it should have been, with the same rows."""
        return true_map(value, self.poses) if isinstance(value, Map) else value


@dataclass(frozen=True)
class Rerun:
    """Final metrics of a replay, and the errors of its frames (n,) by their names in the metrics; both empty where fewer than 3 poses have truth."""

    metrics: dict[str, Any]
    errors: dict[str, F64]


def row_name(stages: tuple[str, ...]) -> str:
    """Return the name of a row."""
    return " + ".join(stages) or "nothing"


def reruns(recording: Recording) -> dict[tuple[str, ...], Rerun]:
    """Return the replay with each row of stages replaced by the truth, beginning with none. Raises DataError, StageError."""
    truth = true_poses(recording)
    with tempfile.TemporaryDirectory() as folder:
        return {stages: rerun(recording, truth, stages, Path(folder)) for stages in ROWS if recording.topics.issuperset(stages)}


def remarks(found: Mapping[tuple[str, ...], Rerun]) -> list[str]:
    """Return sentences on the rows whose ATE is not comparable with that of the whole run, or differs from it by no more than chance."""
    whole = found[()]
    second = int(whole.metrics.get("rpe_second_frames") or 1)
    samples = {stages: Sample({}, {"ATE m": one.errors[ATE]}, second) for stages, one in found.items() if ATE in one.errors}
    pairs = {("", row_name(stages)): [(samples[()], sample)] for stages, sample in samples.items() if stages and () in samples}
    verdicts = verdicts_of(pairs, {"ATE m": Column(4)})
    frames = whole.metrics.get("poses_with_truth", 0)
    fewer = [row_name(stages) for stages, one in found.items() if one.metrics.get("poses_with_truth", 0) < frames]
    short = [one.second for one in verdicts if one.answer == TOO_SHORT]
    equal = [one.second for one in verdicts if one.answer not in (TOO_SHORT, "better", "worse")]
    rows = len(found) - 1
    sentences = []
    if fewer:
        sentences.append(f"These rows track fewer than the whole run's {frames} poses, so that their errors are not comparable: {', '.join(fewer)}.")
    if len(short) == rows:
        sentences.append(f"{frames} poses are too few to tell any row from the whole run.")
    elif short:
        sentences.append(f"{frames} poses are too few to tell these rows from the whole run: {', '.join(short)}.")
    if len(equal) == rows:
        sentences.append(f"No row differs from the whole run by more than its noise over {frames} poses.")
    elif equal:
        sentences.append(f"These rows differ from the whole run by no more than its noise over {frames} poses: {', '.join(equal)}.")
    return sentences


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


def rerun(recording: Recording, truth: Truth, stages: tuple[str, ...], folder: Path) -> Rerun:
    """Replay with the topics of `stages` true."""
    source, out = folder / "source.mcap", folder / "run"
    rewrite(recording, source, {name: getattr(truth, name) for name in stages})
    metrics = replay_metrics(source, dependent_stages(recording, stages), out)
    reference = attached_truth(recording.attachments, str(recording.path))
    if reference is None or not metrics:
        return Rerun({}, {})
    stamps = np.array([pose.stamp_ns for pose in recording.values("pose")], np.int64)
    estimate = read_trajectory(out / "trajectory.txt")
    return Rerun(metrics, frame_errors(estimate, reference, float(metrics["rpe_second_frames"]), stamps))


def dependent_stages(recording: Recording, stages: tuple[str, ...]) -> tuple[str, ...]:
    """Return the stages that depend on one of these, over any number of wires, without these; of none, those of the first row."""
    graph = graph_of(composed_run(recording))
    first = [stage for stage in stages or ("rotation",) if stage in graph.stages]
    found = graph.required_stages([name for name in ("pose", "map") if name in graph.stages], stages)
    return tuple(stage for stage in followers(graph, first) if stage not in stages and stage in found)


def rewrite(recording: Recording, path: Path, changed: Mapping[str, Callable[[Value], Value]]) -> None:
    """Copy the recording's topics, those in `changed` through the function given there."""
    writer = RecordingWriter(path, {name: text for name, text in recording.metadata.items() if name != "format"})
    for name, text in recording.attachments.items():
        writer.attach(name, text)
    for topic in sorted(recording.topics):
        for value in map(changed.get(topic, lambda value: value), recording.values(topic)):
            writer.write(topic, value)
    writer.close()


def replay_metrics(source: Path, stages: tuple[str, ...], out: Path) -> dict[str, Any]:
    """Run the stages again over the recording; the final metrics."""
    from trihedron.pipeline.app.cli import main as trihedron

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        code = trihedron(["run", f"replay={source}", f"only=[{','.join(stages)}]", f"out={out}"])
    if code:
        raise StageError(f"replay of {', '.join(stages)}", (printed.getvalue().strip().splitlines() or ["failed"])[-1], "run it alone to see more")
    metrics: dict[str, Any] = read_results(out / "metrics.json").get("final") or {}
    return metrics
