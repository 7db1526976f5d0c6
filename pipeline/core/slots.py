"""The slots: the inputs a stage may take, the topics they are wired to by default, and the type it returns.

A slot is a `Protocol`; its name in snake case is the configuration group, the node of the graph and the topic. A plugin takes any subset of the
parameters (same names, same types), and the reserved ones `rng: numpy.random.Generator` and `camera: Camera`, the camera of this frame, and returns
the slot's type or None ("nothing this frame"). Taking `camera` in the place of `frame` lets a replay run the stage without the images.
Frames, units and signs are those of `types`. Parameters `X | None` may come from a delayed wire (`topic@prev`, `topic@k`) and are None at the start.
Feature stages never return None for a readable frame: nothing found is a value with no rows, so that later stages run on the rest.

Default wires: a parameter reads the topic of its own name, `frame` reads `dataset`, `previous` the stage's own last output and `previous_X` the topic
X@prev. `Annotated[..., Wire(...)]` declares any other. A graph changes single wires by `graph.STAGE.INPUT=TOPIC`, `null` for none.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Generic, Protocol, TypeVar, get_type_hints, runtime_checkable

import numpy as np

from trihedron.pipeline.core.types import (
    Building,
    Camera,
    Correction,
    Frame,
    Keypoints,
    LineSegments,
    ManhattanFrame,
    Map,
    Matches,
    Normals,
    Planes,
    Pose,
    PredictedView,
    Rotation,
    Segments,
    Surface,
    Tracks,
    Trajectory,
    Translation,
)
from trihedron.pipeline.core.wires import PREVIOUS, Wire

State = TypeVar("State")
PreviousMap = Annotated[Map | None, Wire("map", PREVIOUS)]  # the map before this frame


RNG, CAMERA = "rng", "camera"
RESERVED: dict[str, Any] = {RNG: np.random.Generator, CAMERA: Camera}  # parameters that any plugin may take


class Dataset(Protocol):
    """A sequence of frames, read on demand, in any order and from any thread.

    `__call__(index)` returns frame `index` (0 <= index < len), or None where it cannot be read, after a warning on the logger `trihedron`.
    Stamps increase strictly with the index. Constructing it is cheap; `len` opens the folder and raises DataError when it cannot be used.
    A frame's own `index` is its number in the whole data set, `frame_range(frames)[index]` of the field `frames` ("A:B" or "A:B:S"). Its camera has
    the rate of the whole data set; a run over every S-th frame divides it by S.
    `truth` is the ground truth `T_world_camera` as the data set gives it (any rate, any subset of the frames), or None."""

    def __len__(self) -> int: ...

    def __call__(self, index: int) -> Frame | None: ...

    def truth(self) -> Trajectory | None: ...


class NormalsSlot(Protocol):
    """Surface normals of the depth image, towards the camera. Measure: angle between the normals of one place in two frames."""

    def __call__(self, frame: Frame) -> Normals | None: ...


class KeypointsSlot(Protocol):
    """Points of interest with descriptors and their 3D positions where depth can be trusted (not across a depth edge).
    Measure: share of the points in view that are not found again in the next frame."""

    def __call__(self, frame: Frame) -> Keypoints | None: ...


class LinesSlot(Protocol):
    """Straight line segments with descriptors; end points lie in the image (-0.5 to its width or height - 0.5), or within a pixel of it.
    Measure: share of the segments in view that are not found again in the next frame."""

    def __call__(self, frame: Frame) -> LineSegments | None: ...


class SegmentsSlot(Protocol):
    """3D lines along the image's segments, fitted robustly to depth; one row per row of `lines`.
    Measure: distance between the lines of one segment in two frames."""

    def __call__(self, frame: Frame, lines: LineSegments) -> Segments | None: ...


class PlanesSlot(Protocol):
    """Planar regions of the depth image. `moments` may be those of a part of a region, the points that the plane was fitted to.
    Measure: distance and angle between one plane in two frames, and the share that is not found again."""

    def __call__(self, frame: Frame, normals: Normals) -> Planes | None: ...


class ManhattanSlot(Protocol):
    """The scene's orthogonal axes seen from the camera (section IV-A). `previous` is this stage's last output: look near it first,
    search the whole of SO(3) when it is None, old or no longer supported; among the 24 equivalent rotations keep the one nearest to it.
    Measure: angle of the axes from their mean, and the share of frames with false ones."""

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame | None: ...


class TracksSlot(Protocol):
    """Features of this frame found in the previous one. A row is paired at most once, but a previous plane may come apart.
    `previous` is this stage's last output, `manhattan` may predict the rotation.
    Measure: shares of wrong and of missed pairs of key points."""

    def __call__(
        self,
        frame: Frame,
        previous_frame: Frame | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous_keypoints: Keypoints | None,
        previous_segments: Segments | None,
        previous_planes: Planes | None,
        manhattan: ManhattanFrame | None,
        previous_manhattan: ManhattanFrame | None,
        previous: Tracks | None,
    ) -> Tracks | None: ...


class RotationSlot(Protocol):
    """The camera's rotation in the world, drift-free where the scene is Manhattan (eq. 1), with the world–Manhattan rotation it maintains.
    `previous` is this stage's last output, `previous_pose` the refined pose before this frame, `map` the map before this frame: a correction may
    have moved the pose's reference keyframe since that pose was estimated, and both move with it. The world is the first frame's camera frame.
    Measure: angle from the true rotation."""

    def __call__(
        self,
        manhattan: ManhattanFrame | None,
        tracks: Tracks | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous: Rotation | None,
        previous_pose: Pose | None,
        map: PreviousMap,
    ) -> Rotation | None: ...


class TranslationSlot(Protocol):
    """The camera's position with the rotation fixed (eqs. 2–7), from features tracked since the last frame; `earlier_pose` is of two frames ago.
    Measure: distance from the true position."""

    def __call__(
        self,
        frame: Frame,
        rotation: Rotation,
        tracks: Tracks | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous_keypoints: Keypoints | None,
        previous_pose: Pose | None,
        earlier_pose: Annotated[Pose | None, Wire("pose", 2)],
        previous: Translation | None,
        map: PreviousMap,
    ) -> Translation | None: ...


class MatchesSlot(Protocol):
    """Map landmarks found among this frame's features, searched around their projection at the decoupled, or recognised, pose (section III-B).
    Measure: shares of wrong and of missed matches of points."""

    def __call__(
        self, frame: Frame, rotation: Rotation, translation: Translation, keypoints: Keypoints, segments: Segments, planes: Planes,
        map: PreviousMap, relocalise: Pose | None,
    ) -> Matches | None: ...  # fmt: skip


class PoseSlot(Protocol):
    """The pose of this frame with its status (section IV-C, eq. 8): every frame gets a pose, `ok` or `degraded` only when it was estimated
    from this frame's measurements; the error of an `ok` one is within its covariance. `map` is the map before this frame, `previous` this stage's
    last output; on a lost one nothing is tracked.
    Measure: ATE, RPE, NEES and the share of frames that are ok."""

    def __call__(
        self,
        frame: Frame,
        previous_frame: Frame | None,
        rotation: Rotation,
        translation: Translation,
        tracks: Tracks | None,
        matches: Matches | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous: Pose | None,
        model: Annotated[PredictedView | None, Wire("model", PREVIOUS)],
        map: PreviousMap,
        relocalise: Pose | None,
    ) -> Pose | None: ...


class MapSlot(Protocol):
    """The only writer of the map: inserts keyframes, culls and fuses landmarks, applies corrections, merges sub-maps. None when nothing changed.
    Measure: that of `pose`."""

    def __call__(
        self,
        frame: Frame,
        pose: Pose,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        matches: Matches | None,
        map: PreviousMap,
        bundle: Annotated[Correction | None, Wire("bundle", 5)],
        loop: Annotated[Correction | None, Wire("loop", 10)],
        relocalise: Pose | None,
    ) -> Map | None: ...


class BundleSlot(Protocol):
    """Joint optimisation of a window of keyframes and landmarks; may take several frames behind a wire `bundle@k`. Measure: that of `pose`."""

    def __call__(self, map: Map) -> Correction | None: ...


class LoopSlot(Protocol):
    """Recognise a place seen before and correct the map. `previous` is this stage's last output. Measure: that of `pose`."""

    def __call__(self, map: Map, frame: Frame, previous: Correction | None) -> Correction | None: ...


class RelocaliseSlot(Protocol):
    """The pose of this frame found against the map without a prediction: for a lost camera `ok`, or `lost` when nothing, or more than one place, was
    recognised; `degraded` for one tracked in a sub-map that was recognised in an older one. None otherwise. Measure: that of `pose`."""

    def __call__(
        self, frame: Frame, rotation: Rotation, keypoints: Keypoints, segments: Segments, planes: Planes, map: PreviousMap, previous_pose: Pose | None
    ) -> Pose | None: ...


class ModelSlot(Protocol):
    """The view of a dense model from the current pose, for frame-to-model tracking; `previous`, its last output, carries the model.
    Measure: that of `pose`."""

    def __call__(self, frame: Frame, pose: Pose, map: Map | None, previous: PredictedView | None) -> PredictedView | None: ...


class SurfaceSlot(Protocol, Generic[State]):
    """A mesh of the scene; empty rather than None. A fold: `start` makes a state, `add` takes it one frame further (`map` where it changed then),
    `finish` transforms it to the final keyframes, as `trajectory.txt` does. Nothing reads it while the camera is tracked.
    Measure: distance from the true surface, and how much of it is covered (`trihedron evaluate-surface`)."""

    def start(self) -> State: ...

    def add(self, state: State, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> State: ...

    def finish(self, state: State, map: Map | None) -> Surface: ...


class BuildingSlot(Protocol, Generic[State]):
    """The storeys, walls, rooms and openings of a building; a plan that names what is missing rather than None. A fold, as `surface` is.
    Measure: rooms and walls against those of the simulated building."""

    def start(self) -> State: ...

    def add(self, state: State, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> State: ...

    def finish(self, state: State, map: Map | None) -> Building: ...


@runtime_checkable
class Localising(Protocol):
    """Optional interface of any plugin: `localising` returns the plugin that takes its place when the camera is only localised in a loaded map, which
    stays as it is (`localise_only=true`)."""

    def localising(self) -> Any: ...


SLOTS: dict[str, type[Any]] = {
    "dataset": Dataset,
    "normals": NormalsSlot,
    "keypoints": KeypointsSlot,
    "lines": LinesSlot,
    "segments": SegmentsSlot,
    "planes": PlanesSlot,
    "manhattan": ManhattanSlot,
    "tracks": TracksSlot,
    "rotation": RotationSlot,
    "translation": TranslationSlot,
    "matches": MatchesSlot,
    "pose": PoseSlot,
    "map": MapSlot,
    "bundle": BundleSlot,
    "loop": LoopSlot,
    "relocalise": RelocaliseSlot,
    "model": ModelSlot,
    "surface": SurfaceSlot,
    "building": BuildingSlot,
}
FOLDS = frozenset({"surface", "building"})


def method_of(slot: str) -> str:
    """Return the method whose signature is the slot's contract: `add` of a fold, else `__call__`."""
    return "add" if slot in FOLDS else "__call__"


@cache
def inputs_of(slot: str) -> Mapping[str, Any]:
    """Return parameter name -> type of a slot's inputs (without self, a fold's state or a data set's index)."""
    hints = get_type_hints(getattr(SLOTS[slot], method_of(slot)))
    return {name: hint for name, hint in hints.items() if name not in ("state", "index", "return")}


@cache
def default_wires(slot: str) -> dict[str, Wire]:
    """Return parameter name -> the wire it has unless the graph states another."""
    hints = get_type_hints(getattr(SLOTS[slot], method_of(slot)), include_extras=True)
    return {name: _default_wire(slot, name, hints[name]) for name in inputs_of(slot)}


def _default_wire(slot: str, parameter: str, hint: Any) -> Wire:
    declared = next((extra for extra in getattr(hint, "__metadata__", ()) if isinstance(extra, Wire)), None)
    if declared is not None:
        return declared
    topic = slot if parameter == "previous" else parameter.removeprefix("previous_")
    return Wire("dataset" if topic == "frame" else topic, PREVIOUS if parameter.startswith("previous") else 0)


@cache
def output_of(slot: str) -> Any:
    """Return the type a slot writes (without None)."""
    return strip_none(get_type_hints(SLOTS[slot].finish if slot in FOLDS else SLOTS[slot].__call__)["return"])


def strip_none(hint: Any) -> Any:
    """Strip None from a type: `X | None` -> X; anything else unchanged."""
    arms = [arm for arm in getattr(hint, "__args__", ()) if arm is not type(None)]
    return arms[0] if accepts_none(hint) and len(arms) == 1 else hint


def accepts_none(hint: Any) -> bool:
    """Return True if a parameter of this type receives None instead of its stage being skipped."""
    return type(None) in getattr(hint, "__args__", ())


def summary(slot: str) -> str:
    """Return the first sentence of a slot's docstring."""
    text = " ".join((inspect.getdoc(SLOTS[slot]) or "").split())
    return re.split(r"(?<=\.) (?=[A-Z`])", text, maxsplit=1)[0]
