"""One line for each type that a user receives: what it is, how much of it there is, how good it is; never its arrays.

A package of plugins registers the line of a type of its own with `describe.register`; the others print their numbers and the shapes of their arrays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import singledispatch
from typing import Any

import numpy as np

from trihedron.pipeline.core.plan_areas import area_sigma
from trihedron.pipeline.core.table import Table
from trihedron.pipeline.core.types import (
    OK,
    Building,
    Correction,
    Effort,
    Frame,
    FrameReference,
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
    Value,
)

LONGEST = 40  # letters of a text


@singledispatch
def describe(value: object) -> str:
    """Return the line that stands for a value."""
    fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
    return f"{type(value).__name__}({', '.join(_field(field.name, getattr(value, field.name)) for field in fields if field.repr)})"


def _field(name: str, value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{name} {value.shape}"
    text = f"{value:.4g}" if isinstance(value, float) else repr(value)
    return f"{name}={text if len(text) <= LONGEST else text[: LONGEST - 1] + '…'}"


def line_of(value: object, *parts: str) -> str:
    """Join the parts of a line, without empty ones: `Planes(12; largest 41 k px)`."""
    return f"{type(value).__name__}({'; '.join(part for part in parts if part)})"


def counted(*pairs: tuple[int, str]) -> str:
    """Return `3 planes, 1 line` of (3, "plane"), (1, "line")."""
    return ", ".join(f"{count} {name}{'s' if count != 1 else ''}" for count, name in pairs)


def short(number: float) -> str:
    """Return a number with at most three digits before `k` or `M`."""
    for size, letter in ((1e6, " M"), (1e4, " k")):
        if number >= size:
            return f"{number / (1e6 if letter == ' M' else 1e3):.3g}{letter}"
    return f"{number:g}"


def sigma_of(covariance: Any) -> tuple[float, float]:
    """Return the standard deviations of a pose's position, mm, and rotation, degrees: the roots of the traces of their covariances."""
    return 1e3 * float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))))


def _number(value: Value) -> str:
    return f"frame {value.index}"


def _share(mask: Any) -> str:
    return f"{100.0 * float(np.mean(mask)) if np.size(mask) else 0.0:.0f} %"


def _features(counts: Iterable[int]) -> str:
    return counted(*zip(map(int, counts), ("point", "line", "plane")))


@describe.register
def _(value: Frame) -> str:
    known = value.depth_m > 0.0
    median = f", median {np.median(value.depth_m[known]):.2f} m" if known.any() else ""
    h, w = value.depth_m.shape
    return line_of(value, f"{value.index} at {value.stamp_ns / 1e9:.3f} s", f"{w} × {h}", f"depth in {_share(known)}{median}")


@describe.register
def _(value: FrameReference) -> str:
    return line_of(value, f"{value.index} at {value.stamp_ns / 1e9:.3f} s", f"{value.camera.width} × {value.camera.height}")


@describe.register
def _(value: Effort) -> str:
    return line_of(value, _number(value), counted((value.level, "word of the budget in force")))


@describe.register
def _(value: Normals) -> str:
    h, w = value.normals.shape[:2]
    grid = f"every {value.stride} px" if value.stride > 1 else ""
    return line_of(value, _number(value), f"{w} × {h}", grid, f"known in {_share(np.isfinite(value.normals[..., 0]))}")


@describe.register
def _(value: Keypoints) -> str:
    return line_of(value, f"{len(value.pixels)}", f"{int(np.isfinite(value.points_m).all(axis=1).sum())} with depth")


@describe.register
def _(value: LineSegments) -> str:
    return line_of(value, f"{len(value.endpoints_px)}")


@describe.register
def _(value: Segments) -> str:
    return line_of(value, f"{len(value.endpoints_px)}", f"{int(np.isfinite(value.endpoints_m).all(axis=(1, 2)).sum())} in 3D")


@describe.register
def _(value: Planes) -> str:
    h, w = value.labels.shape
    largest = f"largest {short(int(value.pixels.max()))} px" if len(value.pixels) else ""
    return line_of(value, f"{len(value.pixels)}", f"{_share(value.labels > 0)} of {w * value.stride} × {h * value.stride}", largest)


@describe.register
def _(value: ManhattanFrame) -> str:
    if not value.supported:
        return line_of(value, _number(value), "not supported")
    several = f"{len(value.ids)} of them" if len(value.ids) > 1 else ""
    inliers = ", ".join(short(int(count)) for count in value.inliers[0]) if len(value.inliers) else "none"
    return line_of(value, _number(value), several, f"inliers of the axes {inliers}")


@describe.register
def _(value: Tracks) -> str:
    return line_of(value, f"frame {value.previous_index} to {value.index}", _features(map(len, (value.keypoints, value.segments, value.planes))))


@describe.register
def _(value: Rotation) -> str:
    return line_of(value, _number(value), f"by {value.source}", f"σ {np.degrees(np.sqrt(np.trace(value.covariance))):.2g}°")


@describe.register
def _(value: Translation) -> str:
    position = ", ".join(f"{x:.3f}" for x in value.t_world_camera)
    sigma = f"σ {1e3 * float(np.sqrt(np.trace(value.covariance))):.2g} mm"
    return line_of(value, _number(value), f"{position} m", sigma, _features(value.inliers) if value.estimated else "predicted")


@describe.register
def _(value: Matches) -> str:
    return line_of(value, _number(value), f"revision {value.map_revision}", _features(map(len, (value.keypoints, value.segments, value.planes))))


@describe.register
def _(value: Pose) -> str:
    mm, deg = sigma_of(value.covariance)
    reason = value.reason if value.status != OK else ""
    return line_of(value, _number(value), value.status, reason, f"σ {mm:.2g} mm, {deg:.2g}°")


@describe.register
def _(value: PredictedView) -> str:
    h, w = value.depth_m.shape
    return line_of(value, _number(value), f"{w} × {h}", f"depth in {_share(value.depth_m > 0.0)}")


@describe.register
def _(value: Trajectory) -> str:
    seconds = float(value.stamps_ns[-1] - value.stamps_ns[0]) / 1e9 if len(value) else 0.0
    metres = float(np.linalg.norm(np.diff(value.poses[:, :3, 3], axis=0), axis=1).sum()) if len(value) else 0.0
    return line_of(value, counted((len(value), "pose")), f"{seconds:.1f} s", f"{metres:.2f} m")


@describe.register
def _(value: Map) -> str:
    keyframes, *landmarks = (int(table.column("alive").sum()) for table in (value.keyframes, value.points, value.lines, value.planes))
    return line_of(value, f"revision {value.revision}", counted((keyframes, "keyframe")), _features(landmarks))


@describe.register
def _(value: Correction) -> str:
    landmarks = _features(map(len, (value.point_ids, value.line_ids, value.plane_ids)))
    return line_of(value, f"of revision {value.based_on}", counted((len(value.keyframe_ids), "keyframe")), landmarks)


@describe.register
def _(value: Surface) -> str:
    planes = f"{counted((len(value.plane_ids), 'plane'))} of {value.areas_m2.sum():.1f} m²" if len(value.plane_ids) else ""
    return line_of(value, f"{short(len(value.triangles))} triangles", planes)


def summary_of_building(value: Building) -> str:
    """Return the numbers of elements, the area of the rooms and the note of a plan."""
    sigma = float(np.sqrt(sum(area_sigma(value, room) ** 2 for room in range(len(value.areas_m2)))))
    area = f" of {value.areas_m2.sum():.2f} ± {sigma:.2f} m²" if len(value.areas_m2) else ""
    rooms = counted((len(value.storeys), "storey"), (len(value.areas_m2), "room")) + area
    counts = f"{rooms}, {counted((len(value.walls_m), 'wall'), (len(value.spans_m), 'opening'))}"
    return counts + (f"; {value.note}" if value.note else "")


@describe.register
def _(value: Building) -> str:
    return line_of(value, summary_of_building(value))


@describe.register
def _(value: Table) -> str:
    return line_of(value, counted((value.size, "row")), ", ".join(value.schema))
