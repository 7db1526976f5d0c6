"""Small stages with known arithmetic, to test the machinery without any algorithm."""

import contextlib
import io
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest
from mcap.reader import make_reader

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core import types
from trihedron.pipeline.core.graph import build_graph
from trihedron.pipeline.core.table import Column, Table
from trihedron.pipeline.core.types import Camera, Frame, Keypoints, Map, Normals, Pose, Rotation, Surface

CAMERA = Camera(8, 6, 4.0, 4.0, 3.5, 2.5)


def empty(columns):
    """A table of the columns that every map has."""
    lengths = {name: tuple(size or 2 for size in shape) for name, (_, shape, *_) in columns.columns.items()}
    return Table.empty({name: Column(dtype, lengths[name]) for name, (dtype, *_) in columns.columns.items()})


EMPTY = empty(types.POINTS)
OTHERS = [empty(columns) for columns in (types.LINES, types.PLANES, types.POINT_OBSERVATIONS, types.LINE_OBSERVATIONS, types.PLANE_OBSERVATIONS)]
KEYFRAMES, _ = empty(types.KEYFRAMES).appended(
    **{
        name: np.broadcast_to(np.eye(*shape) if len(shape) == 2 else np.ones(shape), (1, *shape)) * (name not in ("points", "lines", "planes"))
        for name, (_, shape, *_) in types.KEYFRAMES.columns.items()
    }
)


@dataclass(frozen=True)
class ToyDataset:
    """`length` frames of 8×6; numbers in `unreadable` cannot be read."""

    length: int = 12
    unreadable: tuple[int, ...] = ()
    start: int = 0  # number of the first frame
    stride: int = 1  # from the number of a frame to the next

    def __len__(self) -> int:
        return self.length

    def __call__(self, index: int) -> Frame | None:
        index = self.start + index * self.stride
        if index in self.unreadable:
            return None
        rng = np.random.default_rng(index)
        color = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
        return Frame(index, 1_000 * index, color, rng.random((6, 8), dtype=np.float32), CAMERA)

    def truth(self) -> None:
        return None


@dataclass(frozen=True)
class ToyNormals:
    factor: float = 1.0

    def __call__(self, frame: Frame) -> Normals | None:
        time.sleep(0.0005 * (frame.index % 3))
        normals = np.repeat(frame.depth_m[:, :, None], 3, axis=2) * np.float32(self.factor)
        return Normals(frame.index, frame.stamp_ns, normals, 1)


@dataclass(frozen=True)
class ToyKeypoints:
    """Random points: as many as the frame's number, from the generator the runner seeds. Nothing on every fifth frame."""

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Keypoints | None:
        n = frame.index
        if n % 5 == 4:
            return None
        floats = [rng.random(shape, dtype=np.float32) for shape in ((n, 2), (n, 3), (n,), (n,), (n,))]
        octaves, descriptors = np.zeros(n, np.uint8), rng.integers(0, 255, (n, 32), dtype=np.uint8)
        return Keypoints(n, frame.stamp_ns, floats[0], floats[1], floats[2], floats[3], octaves, floats[4], descriptors)


@dataclass(frozen=True)
class ToyRotation:
    """Adds up what it is given: its value is the sum of all keypoint counts so far."""

    gain: float = 1.0
    fails_at: int = -1

    def __call__(self, keypoints: Keypoints, previous: Rotation | None, previous_pose: Pose | None) -> Rotation | None:
        if keypoints.index == self.fails_at:
            raise ValueError("matrix is singular")
        total = self.gain * len(keypoints.pixels) + (previous.covariance[0, 0] if previous is not None else 0.0)
        eye, none = np.eye(3), np.empty((0, 3, 3))
        source = "tracks" if previous_pose else "prediction"
        return Rotation(keypoints.index, keypoints.stamp_ns, eye, eye * total, none, none, np.empty(0, np.int32), np.empty(0), source)


@dataclass(frozen=True)
class ToyPose:
    def __call__(self, frame: Frame, rotation: Rotation, previous: Pose | None, map: Map | None) -> Pose | None:
        T = np.eye(4)
        T[0, 3] = rotation.covariance[0, 0] + (len(map.points) if map is not None else 0)
        return Pose(frame.index, frame.stamp_ns, T, np.eye(6), T, -1, np.zeros(3, np.int32), 0, "ok", "")


@dataclass(frozen=True)
class ToyMap:
    """Appends 100 points every third frame and moves the first ones."""

    def __call__(self, frame: Frame, pose: Pose, map: Map | None) -> Map | None:
        if frame.index % 3:
            return None
        points = map.points if map is not None else EMPTY
        if len(points):
            points = points.updated(np.arange(2), position_m=np.full((2, 3), pose.T_world_camera[0, 3]))
        new = {name: np.zeros((100, *column.shape)) for name, column in EMPTY.schema.items()}
        points, _ = points.appended(**{**new, "position_m": np.full((100, 3), frame.index), "alive": np.ones(100, bool)})
        revision = map.revision + 1 if map is not None else 0
        return Map(frame.index, frame.stamp_ns, revision, KEYFRAMES, points, *OTHERS)


@dataclass(frozen=True)
class ToySurface:
    """Counts frames; one vertex per frame."""

    def start(self) -> list[int]:
        return []

    def add(self, state: list[int], pose: Pose) -> list[int]:
        return [*state, pose.index]

    def finish(self, state: list[int], map: Map | None) -> Surface:
        vertices = np.array([[i, 0.0, len(map.points) if map else 0] for i in state]).reshape(-1, 3)
        n = len(vertices)
        empty = Surface.empty(state[-1] if state else 0, 0)
        return replace(empty, vertices_m=vertices.astype(np.float32), colors=np.zeros((n, 3), np.uint8))


TOPICS = frozenset({"keypoints", "rotation", "pose", "map", "surface"})


def toy_graph(outputs=("trajectory", "normals", "surface"), wiring=None, **plugins):
    """The toy graph; `rotation=ToyRotation(...)` and so on replace a stage, `wiring` (stage -> input -> wire) its default wires."""
    chosen = {
        "dataset": ToyDataset(), "normals": ToyNormals(), "keypoints": ToyKeypoints(), "rotation": ToyRotation(), "pose": ToyPose(),
        "map": ToyMap(), "surface": ToySurface(), **plugins,
    }  # fmt: skip
    return build_graph(chosen, outputs, wiring)


def run_in(folder, *jobs):
    """Several `trihedron run` in a folder, which all end well; returns what they print."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.chdir(folder)
        for job in jobs:
            assert main(["run", *job]) == 0, job
    return printed.getvalue()


def contents(path):
    """Channel -> list of (log time, bytes), without /timing."""
    found = {}
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if channel.topic != "/timing":
                found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


__all__ = ["CAMERA", "TOPICS", "ToyDataset", "ToyKeypoints", "ToyNormals", "ToyRotation", "contents", "run_in", "toy_graph"]
