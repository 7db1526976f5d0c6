"""The keyframe views that a building retains, and the evidence gathered from them at their final poses."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import inv, matmul, norm
from trihedron.pipeline.core.options import PositiveFloat, Range
from trihedron.pipeline.core.types import F64, LOST, Frame, Map, Planes, Pose, Rotation
from trihedron.plugins.building.edits import read_edits
from trihedron.plugins.building.evidence import LEVEL_DEG, UPRIGHT_DEG, Evidence
from trihedron.plugins.building.labels import Edit
from trihedron.plugins.building.levels import LEAST_FLOOR_M2, lowest_floor
from trihedron.plugins.shared.keyframe_views import KeyframeView, view_of

STRIDE = 2  # px of a view, between planar points
MOVED_M, TURNED_DEG = 0.25, 15.0  # between views that a plan is made of
LEAST_VIEWS = 40  # for which nearer ones are taken: a short walk has no others
PREVIEW_VIEWS = 60


@dataclass(frozen=True)
class LayoutOptions:
    """Options of every plan."""

    view_width: Annotated[int, Range(16, 4096)] = 160  # px, about, to which images are reduced
    max_sigma_m: PositiveFloat = 0.05  # depth less certain than this is not used
    least_room_m2: PositiveFloat = 1.0
    least_wall_m: PositiveFloat = 0.4  # of tall face, for which there is a wall
    edits: str = ""  # a building.json that was corrected by hand: what was deleted, added or named there is so again
    edits_sha256: str = ""  # that it must have; a recording states that of its run


@dataclass
class BuildingState:
    """The state of a building: the views retained, the Manhattan axes, the last frame and map."""

    views: list[KeyframeView] = field(default_factory=list)
    covariances: list[F64] = field(default_factory=list)  # (6, 6), of their poses in the world
    axes: F64 | None = None  # R_world_manhattan
    first: F64 | None = None  # T_world_camera
    map: Map | None = None  # of the last frame
    keyframes: int = 0
    edits: tuple[Edit, ...] = ()  # made by hand
    index: int = 0
    stamp_ns: int = 0


def empty_state(options: LayoutOptions) -> BuildingState:
    """Return the state before the first frame, with the corrections by hand. Raises DataError or ConfigError for their file."""
    return BuildingState(edits=read_edits(options.edits, options.edits_sha256))


def add_view(
    options: LayoutOptions, state: BuildingState, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None
) -> BuildingState:  # fmt: skip
    """Retain the frame if it became a keyframe; without a map, if the camera has moved since the last. Other frames cost next to nothing."""
    state.index, state.stamp_ns, state.map = frame.index, frame.stamp_ns, map
    if rotation is not None and len(rotation.weights):
        state.axes = rotation.R_world_manhattan[int(np.argmax(rotation.weights))]
    if pose.status == LOST:
        return state
    if state.first is None:
        state.first = pose.T_world_camera
    if map is not None:
        newest, state.keyframes = len(map.keyframes), max(state.keyframes, len(map.keyframes))
        wanted = newest > 0 and int(map.keyframes.rows("index", np.array([newest - 1]))[0]) == frame.index
    else:
        wanted = state.keyframes == 0 and (not state.views or has_moved(state.views[-1].T_world_camera, pose.T_world_camera))
    if wanted:
        view = view_of(frame, planes, pose, map, options.view_width, options.max_sigma_m)
        state.views.append(replace(view, color=view.color[:0, :0].copy()))
        state.covariances.append(pose.covariance)
    return state


def has_moved(before: F64, now: F64, apart: float = 1.0) -> bool:
    """Say if a pose (4, 4) is far enough from another: by that part of MOVED_M or TURNED_DEG."""
    turned = np.arccos(np.clip((np.trace(matmul(before[:3, :3].T, now[:3, :3])) - 1.0) / 2.0, -1.0, 1.0))
    return bool(norm(now[:3, 3] - before[:3, 3]) > apart * MOVED_M or turned > apart * np.radians(TURNED_DEG))


def preview_state(state: BuildingState) -> BuildingState:
    """Return the state with PREVIEW_VIEWS of its views."""
    every = -(-len(state.views) // PREVIEW_VIEWS) if state.views else 1
    return replace(state, views=state.views[::every])


def spread_views(state: BuildingState) -> list[tuple[KeyframeView, F64]]:
    """Choose the views that a plan is made of, with their covariances: those that are MOVED_M or TURNED_DEG apart, as a keyframe every few frames
    adds time and no knowledge; where these are fewer than LEAST_VIEWS, half as far apart, a quarter, or all."""
    chosen: list[tuple[KeyframeView, F64]] = []
    for apart in (1.0, 0.5, 0.25, 0.0):
        chosen = []
        for view, covariance in zip(state.views, state.covariances):
            if not chosen or has_moved(chosen[-1][0].T_world_camera, view.T_world_camera, apart):
                chosen.append((view, covariance))
        if len(chosen) >= LEAST_VIEWS:
            break
    return chosen


def gather_evidence(state: BuildingState, map: Map | None) -> Evidence | None:
    """Gather the planar points of views at their final poses; None when no view shows a plane."""
    kept = [(view, T, C) for view, C in spread_views(state) if (T := view.final_pose(map)) is not None]
    if not kept:
        return None
    views, regions = [(view, T) for view, T, _ in kept], [_regions(view) for view, *_ in kept]
    if not sum(len(points) for points, *_ in regions):
        return None
    facing = [matmul(view.coefficients[:, :3], T[:3, :3].T) for view, T in views]
    R = _axes(state, [T for _, T in views], facing, [region[4] for region in regions])
    T_world_building = np.eye(4)
    T_world_building[:3, :3] = R
    start = state.first if state.first is not None else views[0][1]
    T_world_building[:3, 3] = matmul(R[:, :2], matmul(R[:, :2].T, start[:3, 3]))
    inverse = inv(T_world_building)
    poses = [matmul(inverse, T) for _, T in views]
    drift = np.array([matmul(T[:3, :3], C[:3, :3], T[:3, :3].T) for T, (*_, C) in zip(poses, kept)])
    points = np.concatenate([matmul(p, T[:3, :3].T) + T[:3, 3] for T, (p, *_) in zip(poses, regions)])
    normals = np.concatenate([matmul(n, T[:3, :3].T) for T, (_, n, *_) in zip(poses, regions)])
    information, area = (np.concatenate([region[k] for region in regions]) for k in (2, 3))
    rows = np.repeat(np.arange(len(views), dtype=np.int32), [len(p) for p, *_ in regions])
    found = Evidence(T_world_building, [view for view, _ in views], poses, drift, points, normals, information, area, rows)
    level = lowest_floor(found)
    T_world_building[:3, 3] += R[:, 2] * level
    points[:, 2] -= level
    for T in poses:
        T[2, 3] -= level
    return replace(found)  # nothing that was computed of the evidence holds at this height


def _regions(view: KeyframeView) -> tuple[F64, F64, F64, F64, F64]:
    """Return points (n, 3) on planes, the planes' normals (n, 3), information (n,) and area (n,), in the camera's frame, and the area of each plane
    (k,)."""
    half = STRIDE // 2
    r, c = np.nonzero((view.labels[half::STRIDE, half::STRIDE] > 0) & (view.depth_m[half::STRIDE, half::STRIDE] > 0.0))
    r, c = STRIDE * r + half, STRIDE * c + half
    camera, depth = view.camera, view.depth_m[r, c].astype(np.float64)
    points = camera.back_project(np.stack([c, r], axis=1), depth)
    plane = view.labels[r, c].astype(int) - 1
    normals = view.coefficients[plane, :3]
    away = -(points * normals).sum(axis=1)
    cosine = np.clip(away / np.linalg.norm(points, axis=1), 0.1, 1.0)
    sigma = camera.depth_noise.sigma_m(depth) * np.clip(away / depth, 0.05, None)
    area = (STRIDE * depth) ** 2 / (camera.fx * camera.fy * cosine)
    return points, normals, 1.0 / np.maximum(sigma, 1e-3) ** 2, area, np.asarray(np.bincount(plane, area, len(view.coefficients)), np.float64)


def _axes(state: BuildingState, poses: list[F64], normals: list[F64], areas: list[F64]) -> F64:
    """Return `R_world_building`: up by the level regions, the horizontal axes by the commonest upright direction, y nearest to the first view."""
    up = -np.mean([T[:3, 1] for T in poses], axis=0)
    if state.axes is not None:
        along = matmul(state.axes.T, up)
        best = int(np.argmax(np.abs(along)))
        up = state.axes[:, best] * np.sign(along[best])
    up /= norm(up)
    all_normals, weight = np.concatenate(normals), np.concatenate(areas)
    for _ in range(2):
        leaning = matmul(all_normals, up)
        level = np.abs(leaning) > np.cos(np.radians(LEVEL_DEG))
        if weight[level].sum() > LEAST_FLOOR_M2:
            up = (all_normals[level] * (np.sign(leaning[level]) * weight[level])[:, None]).sum(axis=0)
            up /= norm(up)
    T = state.first if state.first is not None else poses[0]
    ahead = T[:3, 2] - matmul(T[:3, 2], up) * up
    if norm(ahead) < 0.1:
        ahead = -T[:3, 1] + matmul(T[:3, 1], up) * up
    ahead /= norm(ahead)
    right = np.cross(ahead, up)
    upright = np.abs(matmul(all_normals, up)) < np.sin(np.radians(UPRIGHT_DEG))
    turn = dominant_turn(np.arctan2(matmul(all_normals[upright], ahead), matmul(all_normals[upright], right)), weight[upright])
    x = np.cos(turn) * right + np.sin(turn) * ahead
    return np.stack([x, np.cross(up, x), up], axis=1)


def dominant_turn(angles: F64, weight: F64) -> float:
    """Return the angle within ±45° (rad) that most of the weight of directions `angles` (n,) has, modulo 90°; 0 without any."""
    quarter = np.pi / 2.0
    if len(angles) == 0:
        return 0.0
    bins = 360
    histogram = np.bincount((np.mod(angles, quarter) / quarter * bins).astype(int) % bins, weight, bins)
    smooth = sum(np.roll(histogram, k) for k in range(-6, 7))
    turn = (int(np.argmax(smooth)) + 0.5) / bins * quarter
    for limit in np.radians([3.0, 1.5, 1.0]):
        away = np.mod(angles - turn + quarter / 2.0, quarter) - quarter / 2.0
        near = np.abs(away) < limit
        if near.any():
            turn += float((away * weight)[near].sum() / weight[near].sum())
    return float(np.mod(turn + quarter / 2.0, quarter) - quarter / 2.0)
