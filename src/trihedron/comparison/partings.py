"""Differences of alternatives: the frames at which their values part, and the errors of single stages against the ground truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from trihedron.comparison.error_budget import true_poses
from trihedron.comparison.stage_measures import COLUMNS, Seen, stage_errors
from trihedron.comparison.value_differences import common_frames, difference, differing
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import nearest_rotation
from trihedron.pipeline.core.types import F64, LOST, ManhattanFrame, Pose, Rotation, Translation, Value
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.run.metrics import rotation_angles_deg
from trihedron.pipeline.run.replay import RECORDED
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent

MEASURED = ("pose", "translation", "rotation", "manhattan")  # topics with a distance of two values; the first that is there finds the worst
OPEN_LOOP = ("axes deg", "rotation deg", "translation mm", *COLUMNS)  # columns of the errors of single stages
FALSE_AXES = "false axes %"
FALSE_DEG = 5.0  # of a Manhattan frame from the others: a false one


@dataclass
class Parting:
    """First difference of an alternative from the recorded run: frame, topic and field, its size there (text), the number of frames that
    differ, and the worst frame with the distance there."""

    frame: int | None = None
    topic: str = ""
    field: str = ""
    size: str = ""
    frames: int = 0
    worst: int | None = None
    distance: float = 0.0
    unit: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return field name -> value, ready for JSON."""
        return asdict(self)

    def compare(self, index: int, topics: Iterable[str], base: Mapping[str, Any], other: Mapping[str, Any]) -> None:
        """Take the values of a frame; `topics` in data order."""
        parted = False
        for topic in topics:
            x, y = _value(base, topic, index), _value(other, topic, index)
            if x is y or (first := next(differing(x, y), None)) is None:
                continue
            if self.frame is None:
                self.frame, self.topic, self.field, self.size = index, topic, *first
            parted = True
            if self.frame != index:
                break  # that the frame differs is enough
        self.frames += parted
        self._measure(index, base, other)

    def _measure(self, index: int, base: Mapping[str, Any], other: Mapping[str, Any]) -> None:
        topic = next((name for name in MEASURED if name in base and name in other), None)
        if topic is None:
            self.worst = self.frame
            return
        found = distance(_value(base, topic, index), _value(other, topic, index))
        if found is not None and found[0] > self.distance:
            self.worst, (self.distance, self.unit) = index, found


def _value(values: Mapping[str, Any], topic: str, index: int) -> Value | None:
    value = values.get(topic)
    return value if isinstance(value, Value) and value.index == index else None


def distance(x: Value | None, y: Value | None) -> tuple[float, str] | None:
    """Return the distance of two poses or translations (mm), rotations or Manhattan frames (deg), with its unit; None for other values, and where one
    was not estimated."""
    if not (is_estimated(x) and is_estimated(y)):
        return None
    if isinstance(x, Pose) and isinstance(y, Pose):
        return 1e3 * float(np.linalg.norm(x.T_world_camera[:3, 3] - y.T_world_camera[:3, 3])), "mm"
    if isinstance(x, Translation) and isinstance(y, Translation):
        return 1e3 * float(np.linalg.norm(x.t_world_camera - y.t_world_camera)), "mm"
    if isinstance(x, Rotation) and isinstance(y, Rotation):
        return _angle_deg(x.R_world_camera.T @ y.R_world_camera), "deg"
    if isinstance(x, ManhattanFrame) and isinstance(y, ManhattanFrame):
        return _angle_deg(x.rotations[0].T @ nearest_equivalent(y.rotations[0], x.rotations[0])), "deg"
    return None


def is_estimated(value: Any) -> bool:
    """Return True for a value that was estimated from its frame: an unsupported Manhattan frame and a translation that was only predicted are not."""
    if isinstance(value, ManhattanFrame):
        return value.supported and len(value.rotations) > 0
    return isinstance(value, Value) and (not isinstance(value, Translation) or value.estimated)


def _angle_deg(R: F64) -> float:
    return float(rotation_angles_deg(R[None])[0])


@dataclass
class StageErrors:
    """Errors of the values of a stage, or of several, against the true poses, frame by frame, and the share of frames with a value."""

    truth: Mapping[int, F64]  # true pose (4, 4) by frame stamp, or that of the recorded run
    rotations_deg: dict[int, float] = field(default_factory=dict)  # by the number of the frame
    translations_m: dict[int, float] = field(default_factory=dict)
    axes: dict[int, F64] = field(default_factory=dict)  # R_world_manhattan by the true rotation: constant, were the axes right
    measures: dict[str, dict[int, float]] = field(default_factory=dict)  # of `stage_measures`: column -> error by the number of the frame
    frames: int = 0
    seen: int = 0
    present: int = 0
    _before: Seen | None = None
    _map: Any = None  # before this frame

    def take(self, topic: str, values: Mapping[str, Any]) -> None:
        """Add the value of the stage in the next frame, measured beside its inputs there: recorded values, and computed ones where none is recorded.
        Values that other swapped stages compute are not its inputs."""
        value, now = values.get(topic), None
        self.seen, self.present = self.seen + 1, self.present + is_estimated(value)
        if isinstance(value, Value) and (T := self.truth.get(value.stamp_ns)) is not None:
            recorded = {name.removeprefix(RECORDED): item for name, item in values.items() if name.startswith(RECORDED)}
            now = Seen({**values, **recorded, "map": self._map, topic: value}, T)
            for column, error in stage_errors(topic, now, self._before).items():
                self.measures.setdefault(column, {})[self.frames] = error
            if isinstance(value, Rotation):
                self.rotations_deg[self.frames] = _angle_deg(T[:3, :3].T @ value.R_world_camera)
            elif isinstance(value, Translation) and is_estimated(value):
                self.translations_m[self.frames] = float(np.linalg.norm(T[:3, 3] - value.t_world_camera))
            elif isinstance(value, ManhattanFrame) and is_estimated(value):
                self.axes[self.frames] = T[:3, :3] @ value.rotations[0]
        self._before, self.frames = now, self.frames + 1
        self._map = values.get(RECORDED + "map") or self._map

    @staticmethod
    def merge_stages(stages: Sequence[StageErrors]) -> StageErrors:
        """Return the errors of several stages over the same frames as one."""
        whole = StageErrors({})
        for one in stages:
            whole.rotations_deg |= one.rotations_deg
            whole.translations_m |= one.translations_m
            whole.axes |= one.axes
            whole.measures |= one.measures
            whole.frames, whole.seen, whole.present = one.frames, whole.seen + one.seen, whole.present + one.present
        return whole

    def of_frames(self) -> dict[str, F64]:
        """Return each kind of error there is as an array (frames,), NaN where a frame has none."""
        deviations = dict(zip(self.axes, _deviations_deg(list(self.axes.values()))))
        distances = {frame: 1e3 * metres for frame, metres in self.translations_m.items()}
        errors = {"axes deg": deviations, "rotation deg": self.rotations_deg, "translation mm": distances, **self.measures}
        return {name: np.array([values.get(frame, np.nan) for frame in range(self.frames)]) for name, values in errors.items() if values}

    def figures(self, errors: Mapping[str, F64]) -> dict[str, float]:
        """Return the root mean square of each kind of error of `of_frames`, NaN where there is none, and the shares of values and of false axes."""
        found = {name: float(np.sqrt(np.nanmean(np.square(errors[name])))) if name in errors else np.nan for name in OPEN_LOOP}
        false = 100.0 * float(np.mean(_from_most_deg(list(self.axes.values())) > FALSE_DEG)) if self.axes else np.nan
        return {**found, FALSE_AXES: false, "values %": 100.0 * self.present / self.seen if self.seen else np.nan}


def _deviations_deg(axes: Sequence[F64]) -> list[float]:
    """Angles of rotations from their mean, each after the exchange of axes that brings it nearest to the first."""
    if not axes:
        return []
    alike = _alike(axes)
    mean = nearest_rotation(np.mean(alike, axis=0))
    return [_angle_deg(mean.T @ R) for R in alike]


def _from_most_deg(axes: Sequence[F64]) -> F64:
    """Angles (n,) of rotations from the one that is nearest to the others, in the sum of angles, so that false ones do not count."""
    alike = np.array(_alike(axes))
    return min((rotation_angles_deg(np.swapaxes(alike, 1, 2) @ R) for R in alike), key=np.sum)


def _alike(axes: Sequence[F64]) -> list[F64]:
    """Rotations, each after the exchange of axes that brings it nearest to the first."""
    return [nearest_equivalent(R, axes[0]) for R in axes]


def reference_of(recording: Recording) -> tuple[Mapping[int, F64], bool]:
    """Return poses (4, 4) in the world of the run, by stamp, and whether they are true: the ground truth, else the posed frames of the run itself."""
    try:
        return true_poses(recording).poses, True
    except DataError:
        poses = recording.values("pose") if "pose" in recording.topics else []
        return {pose.stamp_ns: pose.T_world_camera for pose in poses if isinstance(pose, Pose) and pose.status != LOST}, False


def changed_by_code(recording: Recording, again: Recording) -> str:
    """Compare the small topics of a recording with what the same stages compute now; returns the first difference, empty where all is equal."""
    topics = [topic for topic in reversed(MEASURED) if topic in recording.topics & again.topics]  # in data order
    frames = common_frames(recording, again)
    found = [one for topic in topics if (one := difference(recording, again, topic, frames)) is not None]
    first = min(found, key=lambda one: one.frame, default=None)
    return f"{first.topic}.{first.field} from frame {first.frame} on" if first is not None else ""
