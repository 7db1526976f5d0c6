"""Judge the detectors by the truth of rendered scenes: normals, key points, lines and planes, each plugin with its defaults.

Normals: the angle to the true normal (median and 90 % of the cells) and the share of the cells with depth that have one. Planes: precision and recall
of the regions; one is correct when it and a connected true region cover 80 % of each other (Hoover et al., "An experimental comparison of range image
segmentation algorithms", PAMI 1996, the rule of SegComp), true regions of less than 1000 px apart. Key points: repeatability, the share of those in
view in both frames that have another within 3 px of their true place, and matching score, the share whose mutually nearest descriptor is there
(Mikolajczyk and Schmid, IJCV 2005). Lines: repeatability, of segments whose true place has another within 3 px and 5° beside half of it. Frames are
5 apart; the scenes are the room, the room without texture and the room with slanted walls, with a Kinect's noise.

Example: trihedron benchmark detectors --json detectors.json
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.config import default_plugins
from trihedron.pipeline.core.errors import TrihedronError, UsageError, did_you_mean
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.registry import load_plugins, options_of, parameters_of_method, plugin_class, plugins_of
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import F64, I32, Bool, Frame, Keypoints, LineSegments, Normals, Planes
from trihedron.pipeline.run.scheduler import single_threaded_libraries
from trihedron.plugins.shared.feature_matching import mutual_matches
from trihedron.tools.arguments import Parser

SCENES: dict[str, dict[str, bool]] = {"room": {}, "plain": {"texture": False}, "slanted": {"slanted": True}}
APART = 5  # frames of a pair
NEAR_PX, NEAR_DEG, BESIDE = 3.0, 5.0, 0.5
OVERLAP = 0.8  # of two regions that are the same (SegComp)
LEAST_PX = 1000  # of a true region
VISIBLE = 0.03  # share of the depth by which a point that is visible may be off
Figures = dict[str, float]


@dataclass(frozen=True)
class TrueView:
    """A frame with its truth."""

    frame: Frame
    T_world_camera: F64
    depth_m: F64  # (h, w)
    labels: I32  # (h, w) the plane of each pixel, -1 = curved
    planes: F64  # (k, 4), camera frame

    @cached_property
    def normals(self) -> Normals:
        """The default normals, for detectors of planes."""
        value: Normals = plugin_class("normals", default_plugins()["normals"])()(self.frame)
        return value

    def seen_from(self, other: TrueView, pixels: F64) -> tuple[F64, Bool]:
        """The true places (n, 2) in another view of the points at pixels (n, 2) of this one, and whether they are visible there."""
        camera = self.frame.camera
        at = np.rint(pixels).astype(int)
        depth = self.depth_m[at[:, 1].clip(0, camera.height - 1), at[:, 0].clip(0, camera.width - 1)]
        points = transform(invert(other.T_world_camera) @ self.T_world_camera, camera.back_project(pixels, depth))
        places = camera.project(points)
        within = np.isfinite(places) & (places >= 0.0) & (places <= [camera.width - 1, camera.height - 1])
        inside: Bool = np.asarray(within.all(axis=1))
        at = np.rint(np.where(inside[:, None], places, 0)).astype(int)
        there = other.depth_m[at[:, 1], at[:, 0]]
        return places, inside & (np.abs(there - points[:, 2]) <= VISIBLE * points[:, 2])


def main(argv: list[str]) -> int:
    """Print the tables; returns the exit code. Raises UsageError for an unknown slot or a number out of range."""
    parser = Parser("benchmark detectors", __name__)
    parser.add_argument("--slots", default=",".join(JUDGES), metavar="A,B", help="some of them (default: all)")
    parser.add_argument("--pairs", type=int, default=5, metavar="N", help="of frames in each scene (default: 5)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    options = parser.parse(argv)
    if not 1 <= options.pairs <= 100:
        raise UsageError("benchmark detectors", f"--pairs {options.pairs} is out of range", "give 1 to 100")
    for slot in options.slots.split(","):
        if slot not in JUDGES:
            raise UsageError("benchmark detectors", f"'{slot}' is no slot of detectors", did_you_mean(slot, JUDGES))
    load_plugins()
    scenes = {name: views_of(options.pairs, **changes) for name, changes in SCENES.items()}
    found: dict[str, Any] = {}
    for slot in options.slots.split(","):
        found[slot] = judge_plugins(slot, scenes)
        print(report(slot, found[slot]), end="\n\n", flush=True)
    if options.json:
        write_file(options.json, json.dumps(found, indent=1) + "\n")
    return 0


def views_of(pairs: int, **changes: Any) -> list[tuple[TrueView, TrueView]]:
    """Pairs of views, spread over the walk."""
    data = Synthetic(length=150, **changes)
    return [(_view(data, k), _view(data, k + APART)) for k in np.linspace(0, 149 - APART, pairs).astype(int)]


def _view(data: Synthetic, index: int) -> TrueView:
    frame = data(index)
    assert frame is not None
    return TrueView(frame, data.true_pose(index), *data.true_planes(index))


def judge_plugins(slot: str, scenes: dict[str, list[tuple[TrueView, TrueView]]]) -> dict[str, Any]:
    """Plugin -> scene -> figures; for one that cannot run here, why."""
    found: dict[str, Any] = {}
    for name, kind in plugins_of(slot).items():
        if name == "none" or any(option.name == "model" for option in options_of(kind)):
            continue
        try:
            with single_threaded_libraries():
                found[name] = {scene: _figures(slot, kind, pairs) for scene, pairs in scenes.items()}
        except TrihedronError as error:
            found[name] = {"note": str(error)}
    return found


def _figures(slot: str, kind: type[Any], pairs: list[tuple[TrueView, TrueView]]) -> Figures:
    plugin = kind()
    _call_plugin(plugin, slot, pairs[0][0])  # compiles
    values, spent = [], []
    for pair in pairs:
        began = time.perf_counter()
        values.append(tuple(_call_plugin(plugin, slot, view) for view in pair))
        spent.append(0.5e3 * (time.perf_counter() - began))
    rows = [JUDGES[slot](*pair, *value) for pair, value in zip(pairs, values)]
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]} | {"ms": statistics.median(spent)}


def _call_plugin(plugin: Any, slot: str, view: TrueView) -> Any:
    given = {"frame": view.frame, "normals": view.normals, "rng": np.random.default_rng(0)}
    return plugin(**{name: given[name] for name in parameters_of_method(slot, type(plugin))})


def judge_normals(first: TrueView, second: TrueView, a: Normals, b: Normals) -> Figures:
    """Angles to the truth, and the share of cells with depth that have a normal."""
    angles, shares = [], []
    for view, value in ((first, a), (second, b)):
        cells = slice(None, None, value.stride)
        labels, depth = view.labels[cells, cells], view.frame.depth_m[cells, cells]
        known = np.isfinite(value.normals[..., 0]) & (labels >= 0)
        cosine = np.abs((value.normals[known] * view.planes[labels[known], :3]).sum(axis=1))
        angles.append(np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0))))
        shares.append(float(known.sum()) / max(float(np.count_nonzero((depth > 0.0) & (labels >= 0))), 1.0))
    every = np.concatenate(angles) if sum(map(len, angles)) else np.array([90.0])
    return {"median deg": float(np.median(every)), "90 % deg": float(np.quantile(every, 0.9)), "share": float(np.mean(shares))}


def judge_planes(first: TrueView, second: TrueView, a: Planes, b: Planes) -> Figures:
    """Precision and recall of regions, and the median error of the planes of the correct ones."""
    correct = found = wanted = 0
    angles, offsets = [0.0][:0], [0.0][:0]
    for view, value in ((first, a), (second, b)):
        truth, planes = true_regions(view, value.stride)
        sizes = np.bincount(truth.ravel(), minlength=len(planes) + 1)
        least = LEAST_PX / value.stride**2
        wanted += int(np.count_nonzero(sizes[1:] >= least))
        for k in range(len(value.coefficients)):
            mine = value.labels == k + 1
            inside = np.bincount(truth[mine], minlength=len(sizes))
            inside[0] = 0
            best = int(inside.argmax())
            if sizes[best] < least:
                continue
            found += 1
            if inside[best] >= OVERLAP * max(int(np.count_nonzero(mine & (truth > 0))), 1) and inside[best] >= OVERLAP * sizes[best]:
                correct += 1
                true = planes[best - 1]
                angles.append(float(np.degrees(np.arccos(min(value.coefficients[k, :3] @ true[:3], 1.0)))))
                offsets.append(abs(float(value.coefficients[k, 3] - true[3])))
    medians = (float(np.median(angles)), 1e3 * float(np.median(offsets))) if angles else (float("nan"), float("nan"))
    return {"precision": correct / max(found, 1), "recall": correct / max(wanted, 1), "deg": medians[0], "mm": medians[1]}


def true_regions(view: TrueView, stride: int) -> tuple[I32, F64]:
    """Connected true regions on a grid, 1 … k, 0 where there is no depth, and the plane (k, 4) of each."""
    cells = slice(None, None, stride)
    labels, seen = view.labels[cells, cells], view.frame.depth_m[cells, cells] > 0.0
    regions, planes = np.zeros(labels.shape, np.int32), []
    for plane in np.unique(labels[labels >= 0]):
        count, parts = cv2.connectedComponents((labels == plane).astype(np.uint8), connectivity=8)
        for part in range(1, count):
            planes.append(view.planes[plane])
            regions[parts == part] = len(planes)
    return np.where(seen, regions, 0).astype(np.int32), np.array(planes).reshape(-1, 4)


def judge_keypoints(first: TrueView, second: TrueView, a: Keypoints, b: Keypoints) -> Figures:
    """Repeatability and matching score."""
    ways = []
    for view, other, mine, theirs in ((first, second, a, b), (second, first, b, a)):
        places, visible = view.seen_from(other, mine.pixels.astype(np.float64))
        apart = np.linalg.norm(places[visible][:, None] - theirs.pixels[None], axis=-1) if len(theirs.pixels) else np.full((visible.sum(), 1), np.inf)
        repeated = np.count_nonzero(apart.min(axis=1, initial=np.inf) <= NEAR_PX)
        pairs = mutual_matches(mine.descriptors, theirs.descriptors, mine.metric, 1.0)
        good = visible[pairs[:, 0]] & (np.linalg.norm(places[pairs[:, 0]] - theirs.pixels[pairs[:, 1]], axis=1) <= NEAR_PX)
        ways.append((repeated, np.count_nonzero(good), np.count_nonzero(visible)))
    repeated, good, visible = np.sum(ways, axis=0)
    return {"repeatability": repeated / max(visible, 1), "matching score": good / max(visible, 1), "points": 0.5 * (len(a.pixels) + len(b.pixels))}


def judge_lines(first: TrueView, second: TrueView, a: LineSegments, b: LineSegments) -> Figures:
    """Repeatability of segments."""
    ways = []
    for view, other, mine, theirs in ((first, second, a, b), (second, first, b, a)):
        ends = [view.seen_from(other, _on_the_nearer_side(view, mine.endpoints_px[:, k].astype(np.float64))) for k in (0, 1)]
        visible = ends[0][1] & ends[1][1]
        moved = np.stack([ends[0][0], ends[1][0]], axis=1)[visible]
        ways.append((sum(_has_another(line, theirs.endpoints_px.astype(np.float64)) for line in moved), len(moved)))
    repeated, visible_count = np.sum(ways, axis=0)
    return {"repeatability": repeated / max(visible_count, 1), "lines": 0.5 * (len(a.endpoints_px) + len(b.endpoints_px))}


def _on_the_nearer_side(view: TrueView, pixels: F64) -> F64:
    """Pixels (n, 2) of the nearest surface within 2 px, on which an edge before a background is."""
    height, width = view.depth_m.shape
    around = np.array([(dx, dy) for dy in (-2, 0, 2) for dx in (-2, 0, 2)])
    places = np.clip(np.rint(pixels)[:, None] + around, 0, [width - 1, height - 1]).astype(int)
    nearest = view.depth_m[places[..., 1], places[..., 0]].argmin(axis=1)
    return places[np.arange(len(pixels)), nearest].astype(np.float64) if len(pixels) else pixels


def _has_another(line: F64, others: F64) -> bool:
    """True if a segment (2, 2) has one of others (m, 2, 2) beside it."""
    if not len(others):
        return False
    length = max(float(np.linalg.norm(line[1] - line[0])), 1e-9)
    along = (line[1] - line[0]) / length
    across = np.array([-along[1], along[0]])
    relative = others - line[0]
    beside = np.abs(relative @ across).max(axis=1) <= 2.0 * NEAR_PX
    middle = np.abs((relative @ across).mean(axis=1)) <= NEAR_PX
    direction = others[:, 1] - others[:, 0]
    cosine = np.abs(direction @ along) / np.maximum(np.linalg.norm(direction, axis=1), 1e-9)
    spans = np.sort(relative @ along, axis=1)
    shared = np.minimum(spans[:, 1], length) - np.maximum(spans[:, 0], 0.0)
    return bool((beside & middle & (cosine >= np.cos(np.radians(NEAR_DEG))) & (shared >= BESIDE * length)).any())


JUDGES: dict[str, Callable[..., Figures]] = {"normals": judge_normals, "keypoints": judge_keypoints, "lines": judge_lines, "planes": judge_planes}


def report(slot: str, found: dict[str, Any]) -> str:
    """The table of a slot: a row for each plugin and scene."""
    rows, header = [], [slot, "scene"]
    for name, scenes in found.items():
        for scene, figures in scenes.items():
            if isinstance(figures, str):
                rows.append([name, figures])
                continue
            header = [slot, "scene", *figures]
            rows.append([name, scene, *(f"{value:.3g}" if key != "ms" else f"{value:.1f}" for key, value in figures.items())])
    return table([header, *([*row, *[""] * (len(header) - len(row))] for row in rows)], right="ll" + "r" * 8)
