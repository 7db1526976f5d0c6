"""Rendered views with known axes, and the parts of them that estimators of the Manhattan frame are tried on.

What a view shows is decided by the exact normals of the faces behind its pixels, never by what was detected. An axis is *visible* when surfaces
facing along it cover AXIS_SHARE of the image. There is *no Manhattan frame* in a view when no two directions that each carry ABSENT_SHARE of the
image are within RIGHT_ANGLE_DEG of a right angle. Such views are tried without lines, since a line in a wall is at right angles to its normal in
any room. The leaning room shows nothing else; the room with two slanted walls does where floor and ceiling are out of sight.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.simulation.depth_noise import kinect_depth
from trihedron.datasets.simulation.raytracing import Geometry, geometry_of
from trihedron.datasets.simulation.room import BOX, HEIGHT_M, LEAN, RECTANGLE, Room, all_faces, furnished_room, leaning_room
from trihedron.datasets.simulation.shading import Atlas, render
from trihedron.datasets.simulation.textures import bake
from trihedron.pipeline.core.geometry import pose_matrix, rotation_from_quaternion
from trihedron.pipeline.core.registry import parameters_of_method, plugin_class
from trihedron.pipeline.core.types import EXACT_DEPTH, F64, I32, U8, Bool, Camera, DepthNoise, Frame, Normals, Planes, Segments

WIDTH, HEIGHT, FOCAL_PX = 640, 480, 525.0
FREE_M = ((1.5, 1.2, 1.0), (3.5, 2.8, 1.7))  # where cameras are put
AXIS_SHARE = 0.1  # of the image that surfaces along a visible axis cover; the estimators ask for half of that
AXIS_LINES = 4  # lines that make an axis visible
ON_AXIS_DEG = 5.0  # of a line detected
ABSENT_SHARE, RIGHT_ANGLE_DEG = 0.02, 3.0
CLUTTERED = 0.5  # of the normals and of the lines
DEPTHS = ("clean", "noisy")
WHOLE, CLUTTER, SLANTED, LEANING = "whole", "50 % clutter", "slanted", "leaning"
CASES = (WHOLE, "three planes", "two planes", "one plane + lines", "lines only", CLUTTER)
WITHOUT_FRAME = (SLANTED, LEANING)
STAGES = {"normals": "integral_image", "lines": "lsd", "segments": "ransac", "planes": "connected_components"}


@dataclass(frozen=True)
class DirectionView:
    """Output of the feature stages for one rendered view, the true axes `R_camera_manhattan`, and the true axis of each cell of the normals (-1 =
    none) with the share of the image that each axis covers."""

    normals: Normals
    segments: Segments
    planes: Planes
    truth: F64
    axes: NDArray[np.int8]  # (h, w)
    covered: F64  # (3,)

    @cached_property
    def axes_of_planes(self) -> NDArray[np.int64]:
        """(n,) the true axis of most cells of each plane detected, -1 for none."""
        counts = np.zeros((len(self.planes.pixels) + 1, 4), np.int64)
        np.add.at(counts, (self.planes.labels, self.axes + 1), 1)
        most = counts.argmax(axis=1) - 1
        return np.asarray(np.where(counts.max(axis=1) * 2 > counts.sum(axis=1), most, -1)[1:])

    @cached_property
    def lines_on_axes(self) -> NDArray[np.int64]:
        """(3,) how many lines with depth run along each axis."""
        return np.asarray(self._on_axes.sum(axis=0))

    @cached_property
    def length_on_axes(self) -> F64:
        """(3,) share of the length (px) of all lines that runs along each axis."""
        return np.asarray(self._length @ self._on_axes / max(self._length.sum(), 1e-9))

    @cached_property
    def lines_turned(self) -> bool:
        """Return True if lines at right angles to one axis, but along neither of the two others, are in all longer than those along these: a turned
        crate or a slanted pattern that fills the view is a Manhattan frame too, and the better supported one."""
        across = (self._cosines_of_lines <= np.sin(np.radians(ON_AXIS_DEG))) & ~self._on_axes.any(axis=1, keepdims=True)
        along = self._length @ self._on_axes
        return bool((self._length @ across >= along.sum() - along).any())

    @property
    def _on_axes(self) -> Bool:
        """(n, 3) whether a line runs along an axis."""
        return np.asarray(self._cosines_of_lines >= np.cos(np.radians(ON_AXIS_DEG)))

    @property
    def _length(self) -> F64:
        """(n,) px."""
        steps = self.segments.endpoints_px[:, 1] - self.segments.endpoints_px[:, 0]
        return np.asarray(np.linalg.norm(steps, axis=1).astype(np.float64))

    @property
    def _cosines_of_lines(self) -> F64:
        """(n, 3) of each line to each axis; NaN of those without depth."""
        steps = (self.segments.endpoints_m[:, 1] - self.segments.endpoints_m[:, 0]).astype(np.float64)
        return np.asarray(np.abs(steps @ self.truth) / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9))


@dataclass(frozen=True)
class Scene:
    """A room that can be rendered, and what is known of its faces."""

    room: Room
    shear: F64  # (3, 3) that moves cameras with the walls

    def truth_of(self, faces: I32) -> F64:
        """(f,) share of the image of each face, from the (h, w) face numbers."""
        return np.asarray(np.bincount(faces.ravel(), minlength=len(self.normals)) / faces.size)

    def shows_right_angle(self, faces: I32) -> bool:
        """Return True if two directions in view, each on ABSENT_SHARE of the image, are at right angles; parallel faces count together."""
        cosine = np.abs(self.normals @ self.normals.T)
        carried = (cosine > np.cos(np.radians(1.0))) @ self.truth_of(faces)
        seen = np.flatnonzero(carried >= ABSENT_SHARE)
        return bool((cosine[np.ix_(seen, seen)] < np.sin(np.radians(RIGHT_ANGLE_DEG))).any())

    @cached_property
    def normals(self) -> F64:
        """(f, 3) normals in the world, NaN for curved faces."""
        return np.array([face.normal if face.curved == BOX else np.full(3, np.nan) for face in all_faces(self.room)])

    @cached_property
    def axes(self) -> NDArray[np.int8]:
        """(f,) the axis of the world that a face's normal is along, -1 for none."""
        cosine = np.nan_to_num(np.abs(self.normals))
        return np.where(cosine.max(axis=1) > np.cos(np.radians(0.1)), cosine.argmax(axis=1), -1).astype(np.int8)

    @cached_property
    def geometry_and_atlas(self) -> tuple[Geometry, Atlas]:
        """Scene in the form that the ray tracer takes."""
        return geometry_of(self.room), bake(all_faces(self.room), True, 0)


def scenes() -> dict[str, Scene]:
    """The rooms by name: the Manhattan one (WHOLE) and those of WITHOUT_FRAME."""
    return {
        WHOLE: Scene(furnished_room(), np.eye(3)),
        SLANTED: Scene(furnished_room(slanted=True), np.eye(3)),
        LEANING: Scene(leaning_room(), LEAN),
    }


def views(scene: Scene, index: int, without_frame: bool) -> Iterator[tuple[str, DirectionView]]:
    """(clean | noisy, view) of the scene at a position and a uniformly random orientation of number `index`; `without_frame` leaves out a view that
    shows a right angle, and the lines of the others."""
    rng = np.random.default_rng([7, index])
    R = rotation_from_quaternion(rng.standard_normal(4))
    middle = np.array([*np.mean(RECTANGLE, axis=0), HEIGHT_M / 2.0])
    position = middle + scene.shear @ (rng.uniform(*FREE_M) - middle)
    geometry, atlas = scene.geometry_and_atlas
    color, exact, faces, cosine = render(geometry, atlas, _camera("clean"), pose_matrix(R, position))
    if without_frame and scene.shows_right_angle(faces):
        return
    for depth in DEPTHS:
        camera = _camera(depth)
        sensed = kinect_depth(exact, cosine, camera.fx, camera.depth_noise, rng) if depth == "noisy" else exact.astype(np.float32)
        normals, segments, planes = _features(Frame(index, index * 33_333_333, color, sensed, camera))
        h, w, _ = normals.normals.shape
        axes = scene.axes[faces[:: normals.stride, :: normals.stride][:h, :w]]
        covered = np.array([scene.truth_of(faces)[scene.axes == k].sum() for k in range(3)])
        view = DirectionView(normals, segments, planes, R.T.copy(), axes, covered)
        yield depth, _without_lines(view) if without_frame else view


def gray_images(count: int) -> list[U8]:
    """The images of the first views of the Manhattan room, for the reference workload."""
    (geometry, atlas), found = scenes()[WHOLE].geometry_and_atlas, []
    for index in range(count):
        rng = np.random.default_rng([7, index])
        R = rotation_from_quaternion(rng.standard_normal(4))
        color, exact, _, _ = render(geometry, atlas, _camera("clean"), pose_matrix(R, rng.uniform(*FREE_M)))
        found.append(Frame(index, 0, color, exact.astype(np.float32), _camera("clean")).gray)
    return found


def _camera(depth: str) -> Camera:
    noise = DepthNoise() if depth == "noisy" else EXACT_DEPTH
    return Camera(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2.0, (HEIGHT - 1) / 2.0, 30.0, noise)


def _features(frame: Frame) -> tuple[Normals, Segments, Planes]:
    """By the default feature stages."""
    values: dict[str, Any] = {"frame": frame}
    for slot, name in STAGES.items():
        values[slot] = call_stage(plugin_class(slot, name)(), slot, frame.index, values)
    return values["normals"], values["segments"], values["planes"]


def call_stage(plugin: Any, slot: str, index: int, given: dict[str, Any]) -> Any:
    """Call a stage with those of the inputs that it takes, and with the randomness of its frame."""
    return plugin(**inputs_of(plugin, slot, index, given))


def inputs_of(plugin: Any, slot: str, index: int, given: dict[str, Any]) -> dict[str, Any]:
    """Inputs that a stage takes, and the randomness of its frame if it asks for it."""
    given = {**given, "rng": np.random.default_rng([0, index])}
    return {name: given[name] for name in parameters_of_method(slot, type(plugin))}


def case_of(view: DirectionView, case: str) -> DirectionView | None:
    """The view as the case has it, or None where it does not show what the case asks for (two visible axes, unless it names another number).

    Planes: only the surfaces along the two or three axes that cover most, no lines. One plane + lines: the largest, and lines that tell one more
    axis. Lines only: on two axes, each with AXIS_SHARE of the length, unless most are turned. Clutter: half of the normals and half of the lines
    point any way, and planes have half their pixels; what is left of the visible axes must cover as much as without clutter."""
    visible, largest = view.covered >= AXIS_SHARE, np.argsort(-view.covered)
    if case in ("three planes", "two planes"):
        number = 3 if case == "three planes" else 2
        upon = largest[:number]
        return _only(_without_lines(view), np.isin(view.axes, upon), np.isin(view.axes_of_planes, upon)) if visible.sum() >= number else None
    measured = view.lines_on_axes >= AXIS_LINES
    if case == "one plane + lines":
        rows = np.flatnonzero(view.axes_of_planes == largest[0])[:1]
        if len(rows) == 0 or not visible[largest[0]] or not measured[largest[1:]].any():
            return None
        return _only(view, view.planes.labels == rows[0] + 1, np.arange(len(view.planes.pixels)) == rows[0])
    if case == "lines only":
        if (measured & (view.length_on_axes >= AXIS_SHARE)).sum() < 2 or view.lines_turned:
            return None
        return _only(view, np.zeros(view.axes.shape, np.bool_), np.zeros(len(view.planes.pixels), np.bool_))
    if case == CLUTTER:
        visible = view.covered * (1.0 - CLUTTERED) >= AXIS_SHARE
    if visible.sum() < 2:
        return None
    return _add_clutter(view, np.random.default_rng([9, view.normals.index])) if case == CLUTTER else view


def _only(view: DirectionView, cells: Bool, rows: Bool) -> DirectionView:
    """The view with the normals of the chosen cells (h, w) and the chosen planes (n,)."""
    p = view.planes
    number = np.concatenate([[0], np.where(rows, np.cumsum(rows), 0)]).astype(np.uint8)
    kept: dict[str, Any] = {name: getattr(p, name)[rows] for name in ("coefficients", "covariance", "moments", "pixels", "samples_m")}
    normals = np.where(cells[..., None], view.normals.normals, np.float32(np.nan))
    return replace(view, planes=replace(p, labels=number[p.labels], **kept), normals=replace(view.normals, normals=normals))


def _without_lines(view: DirectionView) -> DirectionView:
    s = view.segments
    none: dict[str, Any] = {name: getattr(s, name)[:0] for name in ("endpoints_px", "endpoints_m", "covariance_m2", "descriptors")}
    return replace(view, segments=replace(s, **none))


def _add_clutter(view: DirectionView, rng: np.random.Generator) -> DirectionView:
    """Half of all cells and lines turned any way; the lines about their middles."""
    normals, ends = view.normals.normals.copy(), view.segments.endpoints_m.copy()
    cells = (rng.random(normals.shape[:2]) < CLUTTERED) & np.isfinite(normals[..., 0])
    normals[cells] = _spherical(rng, int(cells.sum()))
    lines = rng.random(len(ends)) < CLUTTERED
    middle, step = ends[lines].mean(axis=1), ends[lines, 1] - ends[lines, 0]
    half = 0.5 * np.linalg.norm(step, axis=1, keepdims=True) * _spherical(rng, len(step))
    ends[lines] = np.stack([middle - half, middle + half], axis=1)
    labels = np.where(cells, 0, view.planes.labels).astype(np.uint8)
    planes = replace(view.planes, labels=labels, pixels=(view.planes.pixels * (1.0 - CLUTTERED)).astype(np.int32))
    return replace(view, normals=replace(view.normals, normals=normals), segments=replace(view.segments, endpoints_m=ends), planes=planes)


def _spherical(rng: np.random.Generator, count: int) -> F64:
    vectors = rng.standard_normal((count, 3))
    return np.asarray((vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32))
