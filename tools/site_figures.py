"""Figures of a run's page: SVG that needs no script, and the scene of the 3D view as packed numbers."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from trihedron.comparison.mesh_files import read_mesh, vertex_colors
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import transform, umeyama
from trihedron.pipeline.core.types import DEGRADED, F64, LOST, OK, Trajectory
from trihedron.pipeline.run.metrics import aligned_errors, associate

WIDTH, HEIGHT = 560, 240
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 12, 34
OURS, TRUTH = "#d55e00", "#0072b2"  # Okabe and Ito's colours, which the colour-blind tell apart
CURVE_COLORS = ("#0072b2", OURS, "#009e73", "#cc79a7", "#e69f00", "#000000", "#56b4e9")
DASHES = ("", "5 4", "2 3", "9 3 2 3")
MOST_CURVES = 12  # of a figure
STATUS_LOOK = {OK: ("#009e73", "ok"), DEGRADED: ("#e69f00", "degraded"), LOST: ("#000000", "lost")}
MOST_POINTS = 500  # of a curve or path
MOST_TRIANGLES = 5000
LARGEST = 32767


@dataclass(frozen=True)
class Figure:
    """An SVG picture and its caption."""

    svg: Markup
    caption: str


def path_figure(estimate: Trajectory, truth: Trajectory | None) -> Figure:
    """Draw the path from above: x to the right, z (ahead of the first camera) up, in metres."""
    ours, true = estimate.poses[:, [0, 2], 3], np.zeros((0, 2))
    if (aligned := aligned_truth(estimate, truth)) is not None:
        true = aligned[:, [0, 2]]
    everything = np.concatenate([ours, true])
    low, high = everything.min(axis=0), everything.max(axis=0)
    size = max(float((high - low).max()), 0.1)
    scale = min(WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM) / size
    middle = 0.5 * (low + high)

    def place(points: F64) -> F64:
        x, y = (scale * (points - middle)).T
        return np.stack([WIDTH / 2 + x, (HEIGHT - BOTTOM + TOP) / 2 - y], axis=1)

    step = nice_step(size)
    bar = f'<path d="M{LEFT},{HEIGHT - 14}h{scale * step:.1f}" stroke="#333" stroke-width="3"/><text x="{LEFT}" y="{HEIGHT - 20}">{step:g} m</text>'
    body = polyline(place(_thin_points(true)), TRUTH, DASHES[1]) + polyline(place(_thin_points(ours)), OURS) + bar
    return Figure(_svg(body, f"Path from above, {len(ours)} poses"), "Path from above: ours in orange, ground truth in blue, dashed.")


def error_figure(estimate: Trajectory, truth: Trajectory) -> Figure | None:
    """Draw the distance of each position from the ground truth after SE(3) alignment, mm over seconds; None for fewer than three pairs."""
    pairs = associate(estimate.stamps_ns, truth.stamps_ns)
    if len(pairs) < 3:
        return None
    errors = 1e3 * aligned_errors(estimate.poses[pairs[:, 0]], truth.poses[pairs[:, 1]])
    seconds = (estimate.stamps_ns[pairs[:, 0]] - estimate.stamps_ns[0]) / 1e9
    body = _axes(seconds[-1], errors.max(), "s", "mm") + polyline(_thin_points(_place_points(seconds, errors, seconds[-1], errors.max())), OURS)
    text = f"Position error over time: median {np.median(errors):.2f} mm, largest {errors.max():.2f} mm"
    return Figure(_svg(body, text), text + ".")


def curve_look(number: int) -> tuple[str, str]:
    """Return the colour and the dashes of one of several curves."""
    return CURVE_COLORS[number % len(CURVE_COLORS)], DASHES[number % len(DASHES)]


def curves_figure(name: str, curves: Sequence[F64], fps: float) -> Figure:
    """Draw the errors (n,) of the same frames in several alternatives over seconds; `name` ends in the unit. A curve is open where there is none."""
    title, _, unit = name.rpartition(" ")
    seconds = np.arange(max(map(len, curves))) / fps
    largest = max((float(np.nanmax(one)) for one in curves if np.isfinite(one).any()), default=1.0)
    top = 1.15 * largest  # room for the unit
    body = _axes(float(seconds[-1]), top, "s", unit)
    for number, values in enumerate(curves):
        known = np.flatnonzero(np.isfinite(values))
        for piece in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
            places = _place_points(seconds[piece], values[piece], float(seconds[-1]), top)
            body += polyline(_thin_points(places), *curve_look(number))
    text = f"{title} over time, {unit}; the largest is {largest:.3g}"
    return Figure(_svg(body, text), text + ".")


def stage_figure(stages: dict[str, dict[str, float]]) -> Figure | None:
    """Draw the median time of each stage as bars, ms."""
    shown = {name: found["p50_ms"] for name, found in stages.items() if found.get("p50_ms")}
    if not shown:
        return None
    row, left, largest = 20, 110, max(shown.values())
    scale = (WIDTH - left - 70) / largest
    body = "".join(
        f'<text x="{left - 6}" y="{row * k + 15}" text-anchor="end">{escape(name)}</text>'
        f'<rect x="{left}" y="{row * k + 4}" width="{max(scale * ms, 1):.1f}" height="13" fill="#56b4e9" stroke="#1b4f72"/>'
        f'<text x="{left + scale * ms + 5:.1f}" y="{row * k + 15}">{ms:.1f}</text>'
        for k, (name, ms) in enumerate(shown.items())
    )
    listed = ", ".join(f"{name} {ms:.1f}" for name, ms in shown.items())
    return Figure(_svg(body, f"Median ms of the stages: {listed}", row * len(shown) + 8), "Median time of each stage, ms.")


def status_figure(statuses: Sequence[str], seconds: Sequence[float]) -> Figure:
    """Draw the status of the frames over time: heights differ, too, so that colour is not needed."""
    last = max(seconds[-1], 1e-9) if seconds else 1e-9
    heights = {OK: 14, DEGRADED: 26, LOST: 40}
    parts, begin = [], 0
    for k in range(1, len(statuses) + 1):
        if k < len(statuses) and statuses[k] == statuses[begin]:
            continue
        x = LEFT + (WIDTH - LEFT - RIGHT) * seconds[begin] / last
        end = LEFT + (WIDTH - LEFT - RIGHT) * (seconds[k] if k < len(seconds) else last) / last
        height = heights[statuses[begin]]
        color = STATUS_LOOK[statuses[begin]][0]
        parts.append(f'<rect x="{x:.1f}" y="{50 - height}" width="{max(end - x, 1):.1f}" height="{height}" fill="{color}"/>')
        begin = k
    counts = ", ".join(f"{sum(s == status for s in statuses)} {name}" for status, (_, name) in STATUS_LOOK.items())
    axis = f'<text x="{LEFT}" y="68">0 s</text><text x="{WIDTH - RIGHT}" y="68" text-anchor="end">{last:.1f} s</text>'
    return Figure(
        _svg("".join(parts) + axis, f"Status of the frames over time: {counts}", 76),
        f"Status over time: {counts}. Low: ok; half: degraded; high: lost.",
    )


def aligned_truth(estimate: Trajectory, truth: Trajectory | None) -> F64 | None:
    """Return the (n, 3) true positions at the poses of a trajectory, in its world; None for fewer than three."""
    pairs = associate(estimate.stamps_ns, truth.stamps_ns) if truth is not None else np.zeros((0, 2), np.int64)
    if truth is None or len(pairs) < 3:
        return None
    expected, positions = truth.poses[pairs[:, 1]][:, :3, 3], estimate.poses[pairs[:, 0]][:, :3, 3]
    return np.asarray(transform(umeyama(expected, positions), expected))


def scene(estimate: Trajectory, truth: Trajectory | None, mesh_file: Path) -> Markup:
    """Return the 3D view's JSON: mesh and paths as base64 of 16-bit numbers, centred and scaled, z up."""
    R_view_world = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    paths = [("ours", _thin_points(estimate.poses[:, :3, 3]), (213, 94, 0), False)]
    if (true := aligned_truth(estimate, truth)) is not None:
        paths.append(("ground truth", _thin_points(true), (0, 114, 178), True))
    mesh = _small_mesh(mesh_file) if mesh_file.is_file() else None
    points = [path[1] for path in paths] + ([mesh[0]] if mesh is not None else [])
    everything = np.concatenate(points) @ R_view_world.T
    low, high = np.percentile(everything, [0.5, 99.5], axis=0)
    middle, size = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-3)

    def pack_points(xyz: F64) -> str:
        return _base64(np.clip(np.rint((xyz @ R_view_world.T - middle) / size * LARGEST), -LARGEST, LARGEST).astype("<i2"))

    content: dict[str, Any] = {"paths": [{"name": n, "points": pack_points(p), "color": c, "dashed": d} for n, p, c, d in paths]}
    if mesh is not None:
        content["mesh"] = {"vertices": pack_points(mesh[0]), "colors": _base64(mesh[1]), "triangles": _base64(mesh[2].astype("<u2"))}
    return Markup(json.dumps(content))  # names of ours and numbers


def _small_mesh(path: Path) -> tuple[F64, NDArray[np.uint8], NDArray[np.int64]] | None:
    """Return vertices, colours and triangles of a PLY, simplified to what a page can carry; None for one that is empty or no mesh."""
    try:
        vertices, faces = read_mesh(path)
    except DataError:
        return None
    if not len(faces):
        return None
    colors = vertex_colors(path, len(vertices))
    cell = float(np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0))) / 1000
    triangles = faces.astype(np.int64)
    while len(triangles) > MOST_TRIANGLES:
        vertices, colors, triangles = _cluster_vertices(vertices, colors, triangles, cell)
        cell *= 1.25
    return vertices, colors, triangles


def _cluster_vertices(
    vertices: F64, colors: NDArray[np.uint8], triangles: NDArray[np.int64], cell_m: float
) -> tuple[F64, NDArray[np.uint8], NDArray[np.int64]]:
    """Merge the vertices of each cell of a grid into their mean, and remove the triangles that collapse or become the same."""
    _, cluster, counts = np.unique(np.floor(vertices / cell_m).astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    cluster = cluster.reshape(-1)
    sums = [np.stack([np.bincount(cluster, column) for column in values.T.astype(np.float64)], axis=1) for values in (vertices, colors)]
    means, mean_colors = (total / counts[:, None] for total in sums)
    merged = cluster[triangles]
    a, b, c = merged.T
    merged = merged[(a != b) & (b != c) & (a != c)]
    _, first = np.unique(np.sort(merged, axis=1), axis=0, return_index=True)
    return means, np.rint(mean_colors).astype(np.uint8), merged[np.sort(first)]


def _base64(values: Any) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


def _thin_points(points: F64) -> F64:
    return points if len(points) <= MOST_POINTS else points[np.linspace(0, len(points) - 1, MOST_POINTS).astype(int)]


def _place_points(x: F64, y: F64, largest_x: float, largest_y: float) -> F64:
    across, up = (WIDTH - LEFT - RIGHT) / max(largest_x, 1e-9), (HEIGHT - TOP - BOTTOM) / max(largest_y, 1e-9)
    return np.stack([LEFT + across * x, HEIGHT - BOTTOM - up * y], axis=1)


def polyline(points: F64, color: str, dashes: str = "") -> str:
    """Return an SVG line through (n, 2) places; nothing for fewer than two."""
    if len(points) < 2:
        return ""
    dash = f' stroke-dasharray="{dashes}"' if dashes else ""
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{places}" fill="none" stroke="{color}" stroke-width="1.8"{dash}/>'


def nice_step(span: float) -> float:
    """Return a round length, about a quarter of a span."""
    magnitude = 10.0 ** np.floor(np.log10(max(span / 4, 1e-9)))
    return float(magnitude * next(factor for factor in (5.0, 2.0, 1.0) if factor * magnitude <= max(span / 4, 1e-9) or factor == 1.0))


def _axes(largest_x: float, largest_y: float, unit_x: str, unit_y: str) -> str:
    parts = [f'<path d="M{LEFT},{TOP}V{HEIGHT - BOTTOM}H{WIDTH - RIGHT}" fill="none" stroke="#888"/>']
    for value in np.arange(0.0, largest_x + 1e-9, nice_step(largest_x)):
        x = _place_points(np.array([value]), np.zeros(1), largest_x, 1.0)[0, 0]
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{value:g}</text>')
    for value in np.arange(0.0, largest_y + 1e-9, nice_step(largest_y)):
        y = _place_points(np.zeros(1), np.array([value]), 1.0, largest_y)[0, 1]
        parts.append(
            f'<path d="M{LEFT},{y:.1f}H{WIDTH - RIGHT}" stroke="#e2e2e2"/><text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>'
        )
    parts.append(f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 4}" text-anchor="end">{unit_x}</text><text x="2" y="{TOP + 2}">{unit_y}</text>')
    return "".join(parts)


def _svg(body: str, title: str, height: int = HEIGHT) -> Markup:
    return Markup(
        f'<svg viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" role="img"><title>{escape(title)}</title>{body}</svg>'
    )  # its parts are escaped
