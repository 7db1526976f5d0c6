"""The slots: what a stage is given and what it must return.

A slot is a `Protocol`; its name in snake case is the configuration group, the node of the graph and the topic. A plugin takes any subset of the
parameters (same names, same types), may also ask for `rng: numpy.random.Generator`, and returns the slot's type or None ("nothing this frame").
Frames, units and signs are those of `types`. Parameters `X | None` may come from a delayed wire (`topic@prev`, `topic@k`) and are None at the start.
Feature stages never return None for a readable frame: nothing found is a value with no rows, so that later stages run on what there is.
"""

from __future__ import annotations

import inspect
import re
from functools import cache
from typing import Any, Generic, Protocol, TypeVar, get_type_hints

from trihedron.pipeline.core.types import (
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

State = TypeVar("State")


class Dataset(Protocol):
    """A sequence of frames, read when asked for, in any order and from any thread.

    `__call__(index)` returns frame `index` (0 <= index < len), or None where it cannot be read, after saying so on the logger `trihedron`.
    Stamps increase strictly with the index. Constructing it is cheap; `len` opens the folder and raises DataError when it cannot be used.
    A frame's own `index` is its number in the whole data set: position plus the start of the field `frames` ("A:B", see `frame_range`).
    `truth` is the ground truth `T_world_camera` as the data set gives it (any rate, any subset of the frames), or None."""

    def __len__(self) -> int: ...

    def __call__(self, index: int) -> Frame | None: ...

    def truth(self) -> Trajectory | None: ...


class NormalsSlot(Protocol):
    """Surface normals of the depth image, towards the camera."""

    def __call__(self, frame: Frame) -> Normals | None: ...


class KeypointsSlot(Protocol):
    """Points of interest with descriptors and their 3D positions where depth can be trusted (not across a depth edge)."""

    def __call__(self, frame: Frame) -> Keypoints | None: ...


class LinesSlot(Protocol):
    """Straight line segments of the image with descriptors."""

    def __call__(self, frame: Frame) -> LineSegments | None: ...


class SegmentsSlot(Protocol):
    """3D lines along the image's segments, fitted robustly to depth; one row per row of `lines`."""

    def __call__(self, frame: Frame, lines: LineSegments) -> Segments | None: ...


class PlanesSlot(Protocol):
    """Planar regions of the depth image."""

    def __call__(self, frame: Frame, normals: Normals) -> Planes | None: ...


class ManhattanSlot(Protocol):
    """The scene's orthogonal axes seen from the camera (section IV-A). `previous` is this stage's last output: look near it first,
    search the whole of SO(3) when it is None, old or no longer supported; among the 24 equivalent rotations keep the one nearest to it."""

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame | None: ...


class TracksSlot(Protocol):
    """Features of this frame found in the previous one. `previous` is this stage's last output, `manhattan` may predict the rotation."""

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
    have moved the pose's reference keyframe since it was said, and both move with it. The world is the first frame's camera frame."""

    def __call__(
        self,
        manhattan: ManhattanFrame | None,
        tracks: Tracks | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous: Rotation | None,
        previous_pose: Pose | None,
        map: Map | None,
    ) -> Rotation | None: ...


class TranslationSlot(Protocol):
    """The camera's position with the rotation fixed (eqs. 2–7), from features tracked since the last frame; `earlier_pose` is of two frames ago."""

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
        earlier_pose: Pose | None,
        previous: Translation | None,
        map: Map | None,
    ) -> Translation | None: ...


class MatchesSlot(Protocol):
    """Map landmarks found among this frame's features, searched around their projection at the decoupled, or recognised, pose (section III-B)."""

    def __call__(
        self, frame: Frame, rotation: Rotation, translation: Translation, keypoints: Keypoints, segments: Segments, planes: Planes,
        map: Map | None, relocalise: Pose | None,
    ) -> Matches | None: ...  # fmt: skip


class PoseSlot(Protocol):
    """The pose of this frame with its status (section IV-C, eq. 8): a pose is always said, and `ok` or `degraded` only when it was estimated
    from this frame's measurements. `map` is the map before this frame, `previous` this stage's last output; on a lost one nothing is tracked."""

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
        model: PredictedView | None,
        map: Map | None,
        relocalise: Pose | None,
    ) -> Pose | None: ...


class MapSlot(Protocol):
    """The only writer of the map: inserts keyframes, culls and fuses landmarks, applies corrections, ties sub-maps. None when nothing changed."""

    def __call__(
        self,
        frame: Frame,
        pose: Pose,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        matches: Matches | None,
        map: Map | None,
        bundle: Correction | None,
        loop: Correction | None,
        relocalise: Pose | None,
    ) -> Map | None: ...


class BundleSlot(Protocol):
    """Joint optimisation of a window of keyframes and landmarks; may take several frames behind a wire `bundle@k`."""

    def __call__(self, map: Map) -> Correction | None: ...


class LoopSlot(Protocol):
    """Recognises a place seen before and corrects the map."""

    def __call__(self, map: Map, frame: Frame) -> Correction | None: ...


class RelocaliseSlot(Protocol):
    """The pose of this frame found against the map without a prediction: for a lost camera `ok`, or `lost` when nothing, or more than one place, was
    recognised; `degraded` for one tracked in a sub-map that was recognised in an older one. None otherwise."""

    def __call__(
        self, frame: Frame, rotation: Rotation, keypoints: Keypoints, segments: Segments, planes: Planes, map: Map | None, previous_pose: Pose | None
    ) -> Pose | None: ...


class ModelSlot(Protocol):
    """The view of a dense model from the current pose, for frame-to-model tracking; `previous`, its last output, carries the model."""

    def __call__(self, frame: Frame, pose: Pose, map: Map | None, previous: PredictedView | None) -> PredictedView | None: ...


class SurfaceSlot(Protocol, Generic[State]):
    """A mesh of the scene; empty rather than None. A fold: `start` makes a state, `add` takes it one frame further (`map` where it changed then),
    `finish` hangs what was gathered on the final keyframes, as `trajectory.txt` does. Nothing reads it while the camera is tracked."""

    def start(self) -> State: ...

    def add(self, state: State, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> State: ...

    def finish(self, state: State, map: Map | None) -> Surface: ...


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
}
FOLDS = frozenset({"surface"})


def frame_range(text: str) -> tuple[int, int | None]:
    """The field `frames` of a data set, half open: "A:B", "A:", ":B" or "" for all -> (start, stop or None). Raises ValueError."""
    match = re.fullmatch(r"\s*(\d*)\s*:\s*(\d*)\s*", text or ":")
    if not match or (match[1] and match[2] and int(match[1]) >= int(match[2])):
        raise ValueError(f"frames: '{text}' is not a range of frames A:B with A < B")
    return int(match[1] or 0), int(match[2]) if match[2] else None


def method_of(slot: str) -> str:
    """The method whose signature is the slot's contract: `add` of a fold, else `__call__`."""
    return "add" if slot in FOLDS else "__call__"


def inputs_of(slot: str) -> dict[str, Any]:
    """Parameter name -> type of a slot's inputs (without self, a fold's state or a data set's index)."""
    hints = get_type_hints(getattr(SLOTS[slot], method_of(slot)))
    return {name: hint for name, hint in hints.items() if name not in ("state", "index", "return")}


@cache
def output_of(slot: str) -> Any:
    """The type a slot writes (without None)."""
    return strip_none(get_type_hints(SLOTS[slot].finish if slot in FOLDS else SLOTS[slot].__call__)["return"])


def strip_none(hint: Any) -> Any:
    """`X | None` -> X; anything else unchanged."""
    arms = [arm for arm in getattr(hint, "__args__", ()) if arm is not type(None)]
    return arms[0] if accepts_none(hint) and len(arms) == 1 else hint


def accepts_none(hint: Any) -> bool:
    """Whether a parameter of this type receives None instead of its stage being skipped."""
    return type(None) in getattr(hint, "__args__", ())


def summary(slot: str) -> str:
    """The first sentence of a slot's docstring."""
    text = " ".join((inspect.getdoc(SLOTS[slot]) or "").split())
    return re.split(r"(?<=\.) (?=[A-Z`])", text, maxsplit=1)[0]
