"""Compare every estimator of the Manhattan frame, on rendered rooms with known axes or on a sweep over one recording.

Without --runs: the synthetic room at random orientations, each estimator from no previous frame and from one up to 10° off. `oblique` is the room
sheared so that no two of its walls are at right angles, without lines (a line in a wall is at right angles to its normal in any room); every claim
there is false. In the room with two slanted walls a claim further than 3° from the axes of the rest is.
An estimator that returns several frames is judged by the nearest.

Example: trihedron manhattan-family --orientations 200
Example: trihedron manhattan-family --runs FOLDER --out FOLDER --sphere 10
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.datasets.noise import kinect_depth
from trihedron.pipeline.errors import UsageError, did_you_mean
from trihedron.pipeline.geometry import exp_so3, pose_matrix, rotation_from_quaternion
from trihedron.pipeline.types import EXACT_DEPTH, F64, Bool, Camera, DepthNoise, Frame, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.numerics.cube_symmetry import CUBE
from trihedron.tools.arguments import Parser, table

WIDTH, HEIGHT, FOCAL_PX = 320, 240, 262.5
FREE_M = ((1.5, 1.2, 1.0), (3.5, 2.8, 1.7))  # where cameras are put
START_DEG, RIGHT_DEG, FALSE_DEG, ON_AXIS_DEG = 10.0, 1.0, 3.0, 5.0
AXIS_SHARE = 0.05  # of the image that planes on a visible axis cover
AXIS_LINES = 4  # lines that make an axis visible
SHEAR = np.array([[1.0, 0.25, 0.25], [0.0, 1.0, 0.25], [0.0, 0.0, 1.0]])
MOST_ORIENTATIONS = 1000
CONDITIONS = ("clean", "noisy", "three planes", "two planes", "one plane + lines", "lines only", "50% clutter", "slanted", "oblique")


@dataclass(frozen=True)
class View:
    """What the feature stages found in one rendered view, and the true axes `R_camera_manhattan`."""

    normals: Normals
    segments: Segments
    planes: Planes
    truth: F64


def main(argv: list[str]) -> int:
    """Print the table; returns the exit code. Raises UsageError for an unknown estimator or a number out of range."""
    from trihedron.pipeline.registry import load_plugins, plugins_of
    from trihedron.tools.rotation_comparison import compare

    parser = Parser("manhattan-family", __name__)
    parser.add_argument("--orientations", type=int, default=200, metavar="N", help=f"views, up to {MOST_ORIENTATIONS} (default: 200)")
    parser.add_argument("--estimators", default="", metavar="A,B", help="some of them (default: all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="compare the runs of experiment=rotation_family instead")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where pictures of --runs go (default: its folder)")
    parser.add_argument("--sphere", type=int, metavar="FRAME", help="with --runs: draw directions and axes of this frame too")
    options = parser.parse_args(argv)
    if options.runs is not None:
        print(compare(options.runs, options.out or options.runs, options.sphere))
        return 0
    if not 1 <= options.orientations <= MOST_ORIENTATIONS:
        raise UsageError("manhattan-family", f"--orientations {options.orientations} is out of range", f"give 1 to {MOST_ORIENTATIONS}")
    load_plugins()
    known = list(plugins_of("manhattan"))
    names = [name for name in options.estimators.split(",") if name] or [name for name in known if name != "none"]
    for name in names:
        if name not in known:
            raise UsageError("manhattan-family", f"there is no estimator '{name}'", did_you_mean(name, known))
    figures = measure(names, options.orientations)
    print(report(figures))
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


def measure(names: Sequence[str], count: int, conditions: Sequence[str] = CONDITIONS) -> list[dict[str, Any]]:
    """The figures of each estimator and condition, over `count` orientations; views that do not meet a condition are left out of it.
    Load the plugins first."""
    from trihedron.pipeline.registry import plugin_class

    kinds = {_scene_of(condition) for condition in conditions}
    rooms = {kind: rendered_views(kind, count) for kind in sorted(kinds)}
    rows = []
    for condition in conditions:
        rng = np.random.default_rng(CONDITIONS.index(condition))
        met = [(i, seen) for i, view in enumerate(rooms[_scene_of(condition)]) if (seen := filtered(view, condition, rng)) is not None]
        for name in names:
            estimator = plugin_class("manhattan", name)()
            rows.append({"estimator": name, "condition": condition, "views": len(met), **_figures(estimator, met, condition)})
    return rows


def _scene_of(condition: str) -> str:
    return condition if condition in ("noisy", "slanted") else "clean"


def rendered_views(kind: str, count: int) -> list[View]:
    """Views of the room at uniformly random orientations, by the default feature stages; `kind` is clean, noisy or slanted."""
    from trihedron.datasets.raytracing import geometry_of
    from trihedron.datasets.room import all_faces, furnished_room
    from trihedron.datasets.shading import render
    from trihedron.datasets.textures import bake
    from trihedron.pipeline.registry import plugin_class

    room = furnished_room(kind == "slanted")
    geometry, atlas = geometry_of(room), bake(all_faces(room), True, 0)
    noise = DepthNoise() if kind == "noisy" else EXACT_DEPTH
    camera = Camera(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2.0, (HEIGHT - 1) / 2.0, 30.0, noise)
    defaults = {"normals": "integral_image", "lines": "lsd", "segments": "ransac", "planes": "connected_components"}
    stages = {slot: plugin_class(slot, name)() for slot, name in defaults.items()}
    views = []
    for index in range(count):
        rng = np.random.default_rng([7, index])
        R = rotation_from_quaternion(rng.standard_normal(4))
        color, exact, _, cosine = render(geometry, atlas, camera, pose_matrix(R, rng.uniform(*FREE_M)))
        depth = kinect_depth(exact, cosine, camera.fx, noise, rng) if kind == "noisy" else exact.astype(np.float32)
        frame = Frame(index, index * 33_333_333, color, depth, camera)
        normals = stages["normals"](frame=frame)
        lines = stages["lines"](frame=frame)
        segments = _called(stages["segments"], "segments", index, {"frame": frame, "lines": lines})
        planes = _called(stages["planes"], "planes", index, {"frame": frame, "normals": normals})
        views.append(View(normals, segments, planes, R.T.copy()))
    return views


def _called(plugin: Any, slot: str, index: int, inputs: dict[str, Any]) -> Any:
    """Call a stage with those of the inputs that it takes, and with the randomness of its frame."""
    from trihedron.pipeline.registry import parameters_of_method

    inputs = {**inputs, "rng": np.random.default_rng([0, index])}
    return plugin(**{name: inputs[name] for name in parameters_of_method(slot, type(plugin))})


def filtered(view: View, condition: str, rng: np.random.Generator) -> View | None:
    """The view as the condition has it, or None where it does not show what the condition asks for (two axes, unless it names another number)."""
    on_planes, covered = _axes_of_planes(view)
    on_lines = np.bincount(_nearest_axis(_directions(view.segments), view.truth) + 1, minlength=4)[1:] >= AXIS_LINES
    largest = np.argsort(-covered)
    seen_planes = covered >= AXIS_SHARE
    if condition in ("three planes", "two planes"):
        number = 3 if condition == "three planes" else 2
        chosen = np.isin(on_planes, largest[:number])
        return _only_planes(replace(view, segments=_no_segments(view)), chosen) if seen_planes.sum() >= number else None
    if condition == "one plane + lines":
        others = on_lines & (np.arange(3) != largest[0])
        one = np.arange(len(on_planes)) == (np.flatnonzero(on_planes == largest[0])[:1] if seen_planes.any() else -1)
        return _only_planes(view, one) if seen_planes.any() and others.any() else None
    if condition == "lines only":
        return _only_planes(view, np.zeros(len(on_planes), np.bool_)) if on_lines.sum() >= 2 else None
    if condition == "oblique":
        return sheared(replace(view, segments=_no_segments(view)), view.truth @ SHEAR @ view.truth.T)
    if seen_planes.sum() < 2:
        return None
    if condition == "50% clutter":
        normals = view.normals.normals.copy()
        random = rng.standard_normal(normals.shape)
        random = (random / np.linalg.norm(random, axis=2, keepdims=True)).astype(np.float32)
        replaced = (rng.random(normals.shape[:2]) < 0.5) & np.isfinite(normals[..., 0])
        normals[replaced] = random[replaced]
        return replace(view, normals=replace(view.normals, normals=normals))
    return view


def sheared(view: View, M: F64) -> View:
    """Everything seen under the linear map M (3, 3) of the camera's space; normals by its inverse transpose."""
    inverse = np.linalg.inv(M)
    normals = view.normals.normals @ inverse
    normals = (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)
    planes, segments = view.planes, view.segments
    turned = planes.coefficients[:, :3] @ inverse
    coefficients = np.column_stack([turned, planes.coefficients[:, 3]]) / np.linalg.norm(turned, axis=1, keepdims=True)
    T = pose_matrix(M, np.zeros(3))
    samples = (planes.samples_m @ M.T).astype(np.float32)
    ends, spread = (segments.endpoints_m @ M.T).astype(np.float32), (M @ segments.covariance_m2 @ M.T).astype(np.float32)
    return View(
        replace(view.normals, normals=normals),
        replace(segments, endpoints_m=ends, covariance_m2=spread),
        replace(planes, coefficients=coefficients, moments=T @ planes.moments @ T.T, samples_m=samples),
        view.truth,
    )


def _axes_of_planes(view: View) -> tuple[Any, F64]:
    """The true axis of each plane (-1 = none), and the share of the image that the planes of each axis cover."""
    axes = _nearest_axis(view.planes.coefficients[:, :3], view.truth)
    return axes, np.bincount(axes + 1, view.planes.pixels, 4)[1:] / (WIDTH * HEIGHT)


def _nearest_axis(directions: F64, R: F64) -> Any:
    cosine = np.abs(directions @ R)
    return np.where(cosine.max(axis=1, initial=0.0) >= np.cos(np.radians(ON_AXIS_DEG)), np.argmax(cosine, axis=1), -1)


def _directions(segments: Segments) -> F64:
    """(n, 3) unit directions of the segments that have depth."""
    steps = (segments.endpoints_m[:, 1] - segments.endpoints_m[:, 0]).astype(np.float64)
    steps = steps[np.isfinite(steps).all(axis=1)]
    return np.asarray(steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9))


def _no_segments(view: View) -> Segments:
    s = view.segments
    return replace(
        s, endpoints_px=s.endpoints_px[:0], endpoints_m=s.endpoints_m[:0], covariance_m2=s.covariance_m2[:0], descriptors=s.descriptors[:0]
    )


def _only_planes(view: View, chosen: Bool) -> View:
    """The view with the chosen planes and the normals upon them."""
    p = view.planes
    number = np.concatenate([[0], np.where(chosen, np.cumsum(chosen), 0)]).astype(np.uint8)
    labels = number[p.labels]
    rows = {name: getattr(p, name)[chosen] for name in ("coefficients", "covariance", "moments", "pixels", "samples_m")}
    normals = np.where(labels[..., None] > 0, view.normals.normals, np.float32(np.nan))
    return replace(view, planes=replace(p, labels=labels, **rows), normals=replace(view.normals, normals=normals))


def _figures(estimator: Any, views: Sequence[tuple[int, View]], condition: str) -> dict[str, Any]:
    """Shares, median error and time, from nothing and from a start up to 10° off."""
    figures: dict[str, Any] = {}
    for start in ("none", "near"):
        errors, claims, times = [], [], []
        for index, view in views:
            inputs: dict[str, Any] = {"normals": view.normals, "segments": view.segments, "planes": view.planes}
            inputs["previous"] = None if start == "none" else _start(view, np.random.default_rng([11, index]))
            began = time.perf_counter()
            found = _called(estimator, "manhattan", index, inputs)
            times.append(1e3 * (time.perf_counter() - began))
            errors.append(error_deg(found, view.truth))
            claims.append(found is not None and found.supported)
        error, claimed = np.array(errors), np.array(claims, np.bool_)
        false = claimed & ((error > FALSE_DEG) | (condition == "oblique"))
        shares = {"within": error <= RIGHT_DEG, "claimed": claimed, "false": false}
        values = {name: float(np.mean(share)) if views else None for name, share in shares.items()}
        median = {"median_deg": float(np.median(error)), "p50_ms": float(np.median(times))} if views else {"median_deg": None, "p50_ms": None}
        figures[start] = {**values, **median}
    return figures


def _start(view: View, rng: np.random.Generator) -> ManhattanFrame:
    """A previous frame up to 10° from the truth."""
    axis = rng.standard_normal(3)
    R = exp_so3(axis / np.linalg.norm(axis) * np.radians(rng.uniform(0.0, START_DEG))) @ view.truth
    known = np.eye(3)[None] * np.radians(1.0) ** 2
    seen, spread, ids = np.full((1, 3), 20, np.int32), np.full((1, 3), 0.05), np.zeros(1, np.int32)
    return ManhattanFrame(view.normals.index - 1, view.normals.stamp_ns - 33_333_333, R[None], ids, known, seen, spread, True)


def error_deg(found: ManhattanFrame | None, truth: F64) -> float:
    """Angle to the nearest of the 24 names of the true axes, of the nearest frame found; 180 for none."""
    if found is None or len(found.rotations) == 0:
        return 180.0
    traces = np.einsum("kji,jm,nmi->kn", found.rotations, truth, CUBE)
    return float(np.degrees(np.arccos(np.clip((traces.max() - 1.0) / 2.0, -1.0, 1.0))))


def report(figures: Sequence[dict[str, Any]]) -> str:
    """The figures as a table; two numbers are those from nothing and from a start up to 10° off."""
    rows: list[list[str]] = [["condition", "estimator", "views", "within 1°", "median (deg)", "claimed", "false claims", "p50 ms"]]
    for row in figures:
        cells = []
        for name, form in (("within", "{:.3f}"), ("median_deg", "{:.2f}"), ("claimed", "{:.3f}"), ("false", "{:.3f}"), ("p50_ms", "{:.2f}")):
            values = [row[start][name] for start in ("none", "near")]
            cells.append(" / ".join("-" if value is None else form.format(value) for value in values))
        rows.append([row["condition"], row["estimator"], str(row["views"]), *cells])
    return table(rows, "llrrrrrr")
