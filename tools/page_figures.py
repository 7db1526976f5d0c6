"""Figures of the pages: SVG that needs no script, the scene of the 3D view as packed numbers, and pictures as small JPEG."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from trihedron.pipeline.core.drawings import Solid
from trihedron.pipeline.core.geometry import upright
from trihedron.pipeline.core.types import DEGRADED, F64, LOST, OK, U8, Surface
from trihedron.tools.export_picture import visible_triangles

WIDTH, HEIGHT = 560, 240
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 12, 34
OURS, TRUTH = "#d55e00", "#0072b2"  # Okabe and Ito's colours, which the colour-blind tell apart
COLORS = (OURS, "#009e73", "#cc79a7", "#000000", "#56b4e9", "#e69f00", TRUTH)  # of runs and of other curves, in all figures
DASHES = ("", "5 4", "2 3", "9 3 2 3")
MOST_CURVES = 12  # of a figure
MOST_LABELLED = 4  # runs whose bars have numbers
STATUS_LOOK = {OK: ("#009e73", "ok"), DEGRADED: ("#e69f00", "degraded"), LOST: ("#000000", "lost")}
MOST_POINTS = 500  # of a curve or path
MOST_VERTICES = 65_536  # of a mesh: the view numbers them by 16 bits
LARGEST = 32767
LIGHT = np.array([0.3, 0.5, 0.8])  # its direction on the model of a building
PICTURE_WIDTH, QUALITY = 900, 65


@dataclass(frozen=True)
class Figure:
    """An SVG picture and its caption."""

    svg: Markup
    caption: str


@dataclass(frozen=True)
class CameraPath:
    """Positions (n, 3) of a camera in metres, z up, with their name and look; in 3D dots of some size, 0 for a line alone."""

    name: str
    color: str
    dashes: str
    positions_m: F64
    dot_px: int


@dataclass(frozen=True)
class Mesh:
    """Vertices (v, 3) in metres, z up, their RGBA (v, 4) and triangles (t, 3), None where each three vertices are one; `shown` at first."""

    name: str
    vertices_m: F64
    colors: U8
    triangles: NDArray[np.int64] | None
    shown: bool = True


def look_of(number: int) -> tuple[str, str]:
    """Return the colour and the dashes of one of several curves."""
    return COLORS[number % len(COLORS)], DASHES[number % len(DASHES)]


def path_figure(paths: Sequence[CameraPath]) -> Figure:
    """Draw paths from above, in metres."""
    everything = np.concatenate([path.positions_m[:, :2] for path in paths])
    low, high = everything.min(axis=0), everything.max(axis=0)
    size = max(float((high - low).max()), 0.1)
    scale = min(WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM) / size
    middle = 0.5 * (low + high)

    def place(points: F64) -> F64:
        x, y = (scale * (points - middle)).T
        return np.stack([WIDTH / 2 + x, (HEIGHT - BOTTOM + TOP) / 2 - y], axis=1)

    step = nice_step(size)
    body = "".join(polyline(place(_thin_points(path.positions_m[:, :2])), path.color, path.dashes) for path in reversed(paths))
    bar = f'<path d="M{LEFT},{HEIGHT - 14}h{scale * step:.1f}" stroke="#333" stroke-width="3"/><text x="{LEFT}" y="{HEIGHT - 20}">{step:g} m</text>'
    return Figure(_svg(body + bar, f"Paths from above: {', '.join(path.name for path in paths)}"), "Path from above.")


def curves_figure(title: str, unit: str, curves: Sequence[tuple[F64, F64]]) -> Figure:
    """Draw values over seconds, a pair of arrays (n,) a curve; it is open where a value is NaN."""
    values = np.concatenate([values[np.isfinite(values)] for _, values in curves])
    largest = float(values.max()) if len(values) else 1.0
    last, top = max(float(seconds[-1]) for seconds, _ in curves if len(seconds)), 1.15 * largest  # room for the unit
    body = _axes(last, top, "s", unit)
    for number, (seconds, values) in enumerate(curves):
        known = np.flatnonzero(np.isfinite(values))
        for piece in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
            body += polyline(_thin_points(_place_points(seconds[piece], values[piece], last, top)), *look_of(number))
    median = f"the median is {np.nanmedian(curves[0][1]):.3g}, " if len(curves) == 1 else ""
    text = f"{title} over time, {unit}; {median}the largest is {largest:.3g}"
    return Figure(_svg(body, text), text + ".")


def stage_figure(runs: Sequence[dict[str, Any]]) -> Figure | None:
    """Draw the median time of each stage in each run as bars, ms; without the data set, which reads or renders the frames."""
    stages = dict.fromkeys(stage for found in runs for stage in found if stage != "dataset")
    bars = [(stage, k, found[stage]["p50_ms"]) for stage in stages for k, found in enumerate(runs) if (found.get(stage) or {}).get("p50_ms")]
    if not bars:
        return None
    row, left, largest = (20 if len(runs) <= MOST_LABELLED else 6), 110, max(ms for _, _, ms in bars)
    scale, parts, last = (WIDTH - left - 70) / largest, [], ""
    for y, (stage, number, ms) in zip(range(0, row * len(bars), row), bars):
        if stage != last:
            parts.append(f'<text x="{left - 6}" y="{y + 15}" text-anchor="end">{escape(stage)}</text>')
        color, last = look_of(number)[0], stage
        parts.append(f'<rect x="{left}" y="{y + 0.2 * row:g}" width="{max(scale * ms, 1):.1f}" height="{0.65 * row:g}" fill="{color}"/>')
        if len(runs) <= MOST_LABELLED:
            parts.append(f'<text x="{left + scale * ms + 5:.1f}" y="{y + 15}">{ms:.1f}</text>')
    listed = ", ".join(f"{stage} {ms:.1f}" for stage, _, ms in bars)
    return Figure(
        _svg("".join(parts), f"Median ms of the stages: {listed}", row * len(bars) + 12),
        "Median time of each stage, ms, without reading or rendering frames.",
    )


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


def surface_mesh(surface: Surface, most: int) -> Mesh | None:
    """Return a surface without its ceiling and small islands, simplified to some number of triangles at most; None where nothing is left."""
    shown = surface.triangles[visible_triangles(surface)]
    if not len(shown):
        return None
    used, corners = np.unique(shown, return_inverse=True)
    vertices, colors, triangles = surface.vertices_m[used] @ upright(surface.up).T, surface.colors[used], corners.reshape(-1, 3)
    cell = float(np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0))) / 1000
    while len(triangles) > most or len(vertices) > MOST_VERTICES:
        vertices, colors, triangles = _cluster_vertices(vertices, colors, triangles, cell)
        cell *= 1.25
    return Mesh("surface", vertices, np.column_stack([colors, np.full(len(colors), 255, np.uint8)]), triangles)


def model_mesh(solids: Sequence[Solid], R_view_world: F64, shown: bool) -> Mesh | None:
    """Return the model of a building, its faces shaded by their direction; None for no face."""
    ordered = sorted((solid for solid in solids if len(solid.triangles)), key=lambda solid: -solid.rgba[3])  # what can be seen through comes last
    if not ordered:
        return None
    faces = np.concatenate([solid.vertices_m[solid.triangles] for solid in ordered]) @ R_view_world.T
    colors = np.repeat([solid.rgba for solid in ordered], [len(solid.triangles) for solid in ordered], axis=0).astype(np.float64)
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    colors[:, :3] *= 0.6 + 0.4 * np.abs(normals @ LIGHT)[:, None] / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Mesh("building", faces.reshape(-1, 3), np.repeat(np.rint(colors).astype(np.uint8), 3, axis=0), None, shown)


def scene(paths: Sequence[CameraPath], meshes: Sequence[Mesh]) -> dict[str, Any]:
    """Return what the 3D view draws: meshes and paths as base64 of 16-bit numbers, centred and scaled, z up."""
    everything = np.concatenate([*(path.positions_m for path in paths), *(mesh.vertices_m for mesh in meshes)])
    low, high = np.percentile(everything, [0.5, 99.5], axis=0)
    middle, size = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-3)

    def pack(xyz: F64) -> str:
        return encode(np.clip(np.rint((xyz - middle) / size * LARGEST), -LARGEST, LARGEST).astype("<i2"))

    return {
        "paths": [{**vars(one), "positions_m": pack(_thin_points(one.positions_m))} for one in paths],
        "meshes": [
            {
                "name": one.name,
                "shown": one.shown,
                "vertices": pack(one.vertices_m),
                "colors": encode(one.colors),
                "triangles": None if one.triangles is None else encode(one.triangles.astype("<u2")),
            }
            for one in meshes
        ],
    }


def embed_picture(file: Path, alt: str) -> dict[str, Any]:
    """Return a picture for a page: JPEG as base64, its alternative text, width and height; empty for a file that is no picture."""
    import cv2

    image = cv2.imread(str(file))
    if image is None:
        return {}
    height = round(image.shape[0] * PICTURE_WIDTH / image.shape[1])
    small = cv2.resize(image, (PICTURE_WIDTH, height), interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    return {"kind": "jpeg", "data": encode(jpeg), "alt": alt, "width": PICTURE_WIDTH, "height": height}


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


def encode(values: NDArray[Any] | bytes) -> str:
    """Return bytes, or those of an array, as base64."""
    return base64.b64encode(values if isinstance(values, bytes) else values.tobytes()).decode()


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
