"""The evidence that every plan of a building is made of: keyframe views, planar points in the building's frame, levels, faces of walls, free space.

A *face* is a vertical plane that planar regions of several views show, seen from one side; *tall* stretches of it reach above doors and furniture.
Free space is a plan of cells, each with the heights that rays passed (Elfes, Computer 1989, without probabilities)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import inv, matmul, norm
from trihedron.pipeline.core.options import PositiveFloat, Range
from trihedron.pipeline.core.types import F64, I32, LOST, Bool, Building, Frame, Map, Planes, Pose, Rotation
from trihedron.plugins.building.common_kernels import LEVELS, U32, carve_kernel
from trihedron.plugins.shared.keyframe_views import KeyframeView, view_of
from trihedron.plugins.shared.voxel_hash_kernels import I64

CELL_M = 0.05  # of the plan of free space, and of stretches along a wall
LEVEL_M = 0.1  # of heights
MARGIN = np.array([0.05, 0.006])  # m, 1/m: how far before its reading a ray ends, two standard deviations of a Kinect more than 5 cm
LEVEL_DEG, UPRIGHT_DEG = 10.0, 10.0  # a region leaning by less is level, or upright
TALL_M = 2.15  # above doors and most furniture
BELOW_CEILING_M = 0.25
LEAST_FLOOR_M2 = 1.0
STOREY_M = 2.0  # least height of a storey
EYE_M = (0.3, 2.4)  # of the camera above its floor
STRIDE = 2  # px of a view, between planar points
MOVED_M, TURNED_DEG = 0.25, 15.0  # after which a frame without a map is kept


@dataclass
class Gathered:
    """The state of a building: the views kept, the Manhattan axes, the last frame and map."""

    views: list[KeyframeView] = field(default_factory=list)
    covariances: list[F64] = field(default_factory=list)  # (6, 6), of their poses in the world
    axes: F64 | None = None  # R_world_manhattan
    first: F64 | None = None  # T_world_camera
    map: Map | None = None  # of the last frame
    keyframes: int = 0
    index: int = 0
    stamp_ns: int = 0


@dataclass(frozen=True)
class LayoutOptions:
    """Options of every plan."""

    view_width: Annotated[int, Range(16, 4096)] = 160  # px, about, to which images are reduced
    max_sigma_m: PositiveFloat = 0.05  # depth less certain than this is not used
    least_room_m2: PositiveFloat = 1.0
    least_wall_m: PositiveFloat = 0.4  # of tall face, for which there is a wall


def add_view(
    options: LayoutOptions, state: Gathered, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None
) -> Gathered:  # fmt: skip
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
        wanted = state.keyframes == 0 and (not state.views or _moved(state.views[-1].T_world_camera, pose.T_world_camera))
    if wanted:
        view = view_of(frame, planes, pose, map, options.view_width, options.max_sigma_m)
        state.views.append(replace(view, color=view.color[:0, :0].copy()))
        state.covariances.append(pose.covariance)
    return state


def _moved(before: F64, now: F64) -> bool:
    """Say if a pose (4, 4) is far enough from another to be kept."""
    turned = np.arccos(np.clip((np.trace(matmul(before[:3, :3].T, now[:3, :3])) - 1.0) / 2.0, -1.0, 1.0))
    return bool(norm(now[:3, 3] - before[:3, 3]) > MOVED_M or turned > np.radians(TURNED_DEG))


@dataclass(frozen=True)
class Evidence:
    """Planar points (n, 3) in the building's frame with the unit normals (n, 3) of their regions, information (n,) of their depth (1/m²) along the
    normal, area (n,) and the view (n,) that shows them; the views in the order of time with `T_building_camera` and the covariance (3, 3) of their
    positions, m²."""

    T_world_building: F64
    views: list[KeyframeView]
    poses: list[F64]
    drift_m2: F64
    points: F64
    normals: F64
    information: F64
    area_m2: F64
    rows: I32

    def chosen(self, mask: Bool) -> Evidence:
        """Return the evidence of some points."""
        return replace(
            self, points=self.points[mask], normals=self.normals[mask], information=self.information[mask], area_m2=self.area_m2[mask],
            rows=self.rows[mask],
        )  # fmt: skip


def evidence_of(state: Gathered, map: Map | None) -> Evidence | None:
    """Gather the planar points of all views at their final poses; None when no view shows a plane."""
    kept = [(view, T, C) for view, C in zip(state.views, state.covariances) if (T := view.settled(map)) is not None]
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
    level = _lowest_floor(found)
    T_world_building[:3, 3] += R[:, 2] * level
    found.points[:, 2] -= level
    for T in found.poses:
        T[2, 3] -= level
    return found


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
    cosine = np.clip(-(points * normals).sum(axis=1) / np.linalg.norm(points, axis=1), 0.1, 1.0)
    sigma = camera.depth_noise.sigma_m(depth) * np.clip(-(points * normals).sum(axis=1) / depth, 0.05, None)
    area = (STRIDE * depth) ** 2 / (camera.fx * camera.fy * cosine)
    return points, normals, 1.0 / np.maximum(sigma, 1e-3) ** 2, area, np.asarray(np.bincount(plane, area, len(view.coefficients)), np.float64)


def _axes(state: Gathered, poses: list[F64], normals: list[F64], areas: list[F64]) -> F64:
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


def drift_variance(evidence: Evidence, direction: F64, information: F64, rows: I32) -> float:
    """Return the variance along a unit direction (3,) of the mean of readings by views `rows` (n,), m², that their poses in the world cause.

    The errors of poses are a random walk, in which the covariance of two is the variance of the earlier."""
    total = np.bincount(rows, information, len(evidence.poses))
    weight = total / total.sum()
    later = np.cumsum(weight[::-1])[::-1] - weight
    return float(matmul(weight * (weight + 2.0 * later), matmul(evidence.drift_m2, direction, direction)))


# Levels: floors and ceilings.


@dataclass(frozen=True)
class Storey:
    """Heights of floor and ceiling and their standard deviations, metres; NaN = not seen."""

    floor_m: float
    ceiling_m: float
    floor_sigma_m: float = float("nan")
    ceiling_sigma_m: float = float("nan")
    reach_m: float = float("inf")  # the height up to which upright surfaces were seen

    @property
    def bottom_m(self) -> float:
        """Return the floor's height, or 0."""
        return self.floor_m if np.isfinite(self.floor_m) else 0.0


def smoothed(values: F64 | I64, weights: F64) -> F64:
    """Weigh each of (n,) values with its neighbours, an odd number of them; there are zeros beyond the ends."""
    padded = np.pad(values.astype(np.float64), len(weights) // 2)
    return np.asarray(matmul(np.lib.stride_tricks.sliding_window_view(padded, len(weights)), weights))


def _peaks(evidence: Evidence, facing: float) -> tuple[F64, F64]:
    """Return heights (n,) and areas (n,) of the levels that face up (1) or down (-1), from the lowest: counted in cells of 10 cm, not in readings."""
    level = evidence.normals[:, 2] * facing > np.cos(np.radians(LEVEL_DEG))
    if not level.any():
        return np.empty(0), np.empty(0)
    places = np.unique(np.floor(evidence.points[level] / [0.1, 0.1, 0.02]).astype(np.int64), axis=0)
    low = int(places[:, 2].min())
    area = smoothed(np.bincount(places[:, 2] - low), np.ones(3)) * 0.01 / 2.0
    padded = np.concatenate([[-1.0] * 4, area, [-1.0] * 4])
    top = np.array([area[k] == padded[k : k + 9].max() and area[k] > 0.0 for k in range(len(area))], bool)
    heights = (np.nonzero(top)[0] + low + 0.5) * 0.02
    return np.asarray(heights, np.float64), np.asarray(area[top], np.float64)


def _lowest_floor(evidence: Evidence) -> float:
    """Return the height of the lowest wide level below a camera that faces up, or of the lowest point less 1 % without one."""
    heights, areas = _peaks(evidence, 1.0)
    eyes = np.array([T[2, 3] for T in evidence.poses])
    for height, area in zip(heights, areas):
        if area >= LEAST_FLOOR_M2 and ((eyes > height + EYE_M[0]) & (eyes < height + EYE_M[1])).any():
            return height_of(evidence, height, 1.0)[0]
    return float(np.percentile(evidence.points[:, 2], 1.0))


LEVEL_NEAR_M = 0.05  # readings of one level


def at_level(evidence: Evidence, height: float, facing: float) -> Bool:
    """Return the points (n,) of a level near `height` that faces up (1) or down (-1)."""
    level = evidence.normals[:, 2] * facing > np.cos(np.radians(LEVEL_DEG))
    return np.asarray(level & (np.abs(evidence.points[:, 2] - height) < LEVEL_NEAR_M), np.bool_)


def height_of(evidence: Evidence, height: float, facing: float) -> tuple[float, float]:
    """Return the height of a level near `height` and its standard deviation."""
    near = at_level(evidence, height, facing)
    return combined(evidence.points[near, 2], evidence.information[near], evidence.rows[near])


def combined(values: F64, information: F64, rows: I32) -> tuple[float, float]:
    """Return the mean of readings and its standard deviation: by the scatter of the views' own means, as readings of one view err together."""
    if len(values) == 0:
        return float("nan"), float("nan")
    count = int(rows.max()) + 1
    weight = np.bincount(rows, information, count)
    seen = weight > 0.0
    means = np.bincount(rows, information * values, count)[seen] / weight[seen]
    share = np.minimum(weight[seen], 4.0 * np.median(weight[seen]))
    share = share / share.sum()
    mean = float(matmul(share, means))
    for _ in range(3):
        away = np.abs(means - mean)
        robust = share * np.minimum(1.0, 0.01 / np.maximum(away, 1e-9))
        mean = float(matmul(robust, means) / robust.sum())
    scatter = float(matmul(share, (means - mean) ** 2))
    views = 1.0 / float(matmul(share, share))
    return mean, float(np.sqrt(scatter / max(views / CORRELATED, 1.0) + SYSTEMATIC_M**2))


CORRELATED = 4.0  # neighbouring keyframes that err alike
SYSTEMATIC_M = 0.002  # what no averaging removes
SCALE = 0.0007  # standard deviation of the scale of the depth, and so of all lengths


def storeys_of(evidence: Evidence) -> list[Storey]:
    """Find the storeys from the lowest: floors at least STOREY_M apart that a camera stood above, each with the widest ceiling over it."""
    heights, areas = _peaks(evidence, 1.0)
    eyes = np.array([T[2, 3] for T in evidence.poses])
    floors: list[float] = []
    for height, area in zip(heights, areas):
        below = ((eyes > height + EYE_M[0]) & (eyes < height + EYE_M[1])).any()
        wide = area >= LEAST_FLOOR_M2 * (3.0 if floors else 1.0)
        if below and wide and (not floors or height > floors[-1] + STOREY_M):
            floors.append(float(height))
    tops, areas = _peaks(evidence, -1.0)
    found = []
    for number, floor in enumerate(floors or [float("nan")]):
        low = floor if np.isfinite(floor) else float(eyes.min()) - 1.0
        high = floors[number + 1] if number + 1 < len(floors) else np.inf
        over = (tops > low + 1.9) & (tops < high) & (areas >= LEAST_FLOOR_M2)
        ceiling = float(tops[over][np.argmax(areas[over])]) if over.any() else float("nan")
        low_mean, low_sigma = height_of(evidence, floor, 1.0) if np.isfinite(floor) else (float("nan"), float("nan"))
        high_mean, high_sigma = height_of(evidence, ceiling, -1.0) if np.isfinite(ceiling) else (float("nan"), float("nan"))
        low_sigma, high_sigma = float(np.hypot(low_sigma, SCALE * low_mean)), float(np.hypot(high_sigma, SCALE * high_mean))
        heights = evidence.points[(evidence.points[:, 2] < high) & (np.abs(evidence.normals[:, 2]) < np.sin(np.radians(UPRIGHT_DEG))), 2]
        reach = float(np.percentile(heights, 98.0)) if len(heights) else float("inf")
        found.append(Storey(low_mean, high_mean, low_sigma, high_sigma, reach))
    return found


# Faces of walls: lines in the plan, with what was seen of them.


@dataclass(frozen=True)
class Face:
    """A line n·p = offset in the plan, with n towards the side it was seen from, and its `count` (k, LEVELS) of readings: cells of CELL_M along
    `along` from `start_m`, levels of LEVEL_M above the storey's floor."""

    normal: F64
    offset_m: float
    start_m: float
    count: I32
    tall: Bool  # (k,) columns that reach high
    members: I64  # its points in the evidence

    @property
    def along(self) -> F64:
        """Return the unit direction (2,) with the seen side on its left."""
        return np.array([self.normal[1], -self.normal[0]])

    def share(self, begin_m: float, end_m: float, columns: Bool) -> float:
        """Return the share of a stretch whose columns (k,) are marked."""
        a, b = (round((value - self.start_m) / CELL_M) for value in (begin_m, end_m))
        wanted = max(b - a, 1)
        return float(columns[max(a, 0) : max(max(a, 0), b, 0)].sum()) / wanted if b > a else float(columns[min(max(a, 0), len(columns) - 1)])


def tall_m(storey: Storey) -> float:
    """Return the height above the floor that only walls reach, or that nothing much was seen above."""
    top = storey.ceiling_m if np.isfinite(storey.ceiling_m) else storey.reach_m
    return float(min(TALL_M, top - storey.bottom_m - BELOW_CEILING_M))


SNAP_DEG = 3.0  # a direction nearer to an axis of the building is that axis
BINS = 180  # of 1°


def slanted_directions(evidence: Evidence, storey: Storey, apart_deg: float, least_m2: float) -> F64:
    """Return the directions (n,) of walls along neither axis, degrees: peaks with at least that area of tall points."""
    tall = (np.abs(evidence.normals[:, 2]) < np.sin(np.radians(UPRIGHT_DEG))) & (evidence.points[:, 2] - storey.bottom_m > tall_m(storey))
    angles = np.mod(np.degrees(np.arctan2(evidence.normals[tall, 1], evidence.normals[tall, 0])), 180.0)
    weight = evidence.area_m2[tall]
    histogram = np.bincount(angles.astype(int) % BINS, weight, BINS)
    smooth = sum((np.roll(histogram, k) for k in (-2, -1, 1, 2)), histogram)
    found = [0.0, 90.0]
    for best in np.argsort(-smooth, kind="stable"):
        near = np.abs(_turned(angles, best + 0.5)) < 2.5
        if smooth[best] < least_m2 or not weight[near].any():
            break
        angle = best + 0.5 + float(np.average(_turned(angles[near], best + 0.5), weights=weight[near]))
        if all(abs(float(_turned(np.array(angle), other))) > max(apart_deg, SNAP_DEG) for other in found):
            found.append(angle)
    return np.array(found[2:])


def _turned(angles: F64, middle: float) -> F64:
    """Return by how much directions modulo 180° are turned from another, in degrees."""
    return np.asarray(np.mod(angles - middle + 90.0, 180.0) - 90.0)


SAME_FACE = 10  # cm: of two faces of one direction that are nearer to each other, the lesser is furniture
NEAR_FACE_M = 0.05
LEAST_READINGS = 2  # for which a column reaches high
HIGH_M = 1.5  # reached by a column that rays neither pass over nor get behind
ASIDE_M = 0.1  # before and behind a face, where a ray that crosses it is sought
CROSSED = 2  # levels of rays over a column, for which it ends below the ceiling


def faces_of(evidence: Evidence, storey: Storey, space: FreeSpace, directions: F64, least_m: float, cone_deg: float = 6.0) -> list[Face]:
    """Find the faces with unit normals among `directions` (d, 2) that reach high over a stretch of at least that length."""
    found: list[Face] = []
    height = evidence.points[:, 2] - storey.bottom_m
    top = storey.ceiling_m - storey.bottom_m - 0.05 if np.isfinite(storey.ceiling_m) else LEVELS * LEVEL_M
    upright = (np.abs(evidence.normals[:, 2]) < np.sin(np.radians(UPRIGHT_DEG))) & (height > 0.0) & (height < top)
    for normal in directions:
        facing = matmul(evidence.normals[:, :2], normal) > np.cos(np.radians(cone_deg))
        found += _faces_along(evidence, height, normal, np.nonzero(upright & facing)[0], storey, space, least_m)
    return found


def _faces_along(evidence: Evidence, height: F64, normal: F64, members: I64, storey: Storey, space: FreeSpace, least_m: float) -> list[Face]:
    """Find the faces of one direction: the peaks of the offsets of its high points."""
    high = height[members] > min(HIGH_M, tall_m(storey))
    if not high.any():
        return []
    offsets = matmul(evidence.points[members, :2], normal)
    along = matmul(evidence.points[members, :2], np.array([normal[1], -normal[0]]))
    levels = np.clip((height[members] / LEVEL_M).astype(int), 0, LEVELS - 1)
    weight = np.sqrt(evidence.information[members]) * evidence.area_m2[members]
    low = float(offsets[high].min()) - 0.1
    bins = np.bincount(((offsets[high] - low) / 0.01).astype(int), weight[high])
    smooth = smoothed(np.concatenate([bins, np.zeros(10)]), np.array([0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25]))
    around = np.concatenate([np.full(SAME_FACE, -1.0), smooth, np.full(SAME_FACE, -1.0)])
    found = []
    for best in np.nonzero(smooth > 0.0)[0]:
        near = np.abs(offsets[high] - (low + (best + 0.5) * 0.01)) < 0.03
        if smooth[best] < around[best : best + 2 * SAME_FACE + 1].max() or not near.any():
            continue
        offset = float(np.average(offsets[high][near], weights=weight[high][near]))
        close = np.nonzero(np.abs(offsets - offset) < NEAR_FACE_M)[0]
        start = float(along[close].min())
        columns = ((along[close] - start) / CELL_M).astype(int)
        width = int(columns.max()) + 1
        count = np.bincount(columns * LEVELS + levels[close], minlength=width * LEVELS).reshape(width, LEVELS).astype(np.int32)
        reach = _filled(_reaching(Face(normal, offset, start, count, np.zeros(len(count), np.bool_), members[close]), space, storey))
        if _longest(reach) * CELL_M >= least_m:
            found.append(Face(normal, offset, start, count, reach, members[close]))
    return found


def _reaching(face: Face, space: FreeSpace, storey: Storey) -> Bool:
    """Return the columns (k,) of a face that reach high and that rays do not pass over: above doors and furniture, or to HIGH_M where rays get behind
    at less than half of the levels that were read, which noise does."""
    top = np.where(face.count.any(axis=1), LEVELS - 1 - np.argmax(face.count[:, ::-1] > 0, axis=1), -1)
    levels = np.arange(LEVELS)
    tall = face.count[:, levels * LEVEL_M > tall_m(storey)].sum(axis=1) >= LEAST_READINGS
    line = (face.start_m + (np.arange(len(top)) + 0.5) * CELL_M)[:, None] * face.along + face.offset_m * face.normal
    behind = space.at(line - ASIDE_M * face.normal)
    crossed = behind & space.at(line) & space.at(line + ASIDE_M * face.normal)
    passed, over = _bits(behind), _bits(crossed) & (levels > top[:, None] + 1)
    solid = (top * LEVEL_M >= HIGH_M) & (2 * passed.sum(axis=1) < (face.count > 0).sum(axis=1))
    return np.asarray((tall | solid) & (over.sum(axis=1) < CROSSED), np.bool_)


def _bits(levels: U32) -> Bool:
    """Return the bits (n, LEVELS) of levels (n,)."""
    return np.asarray((levels[:, None] >> np.arange(LEVELS, dtype=np.uint32)) & np.uint32(1), np.bool_)


def _longest(columns: Bool) -> int:
    """Return the length of the longest run of marked columns."""
    ends = np.nonzero(np.diff(np.concatenate([[False], columns, [False]])))[0]
    return int(np.diff(ends)[::2].max(initial=0))


def _filled(columns: Bool, gap: int = 2) -> Bool:
    """Close gaps of so many columns or fewer."""
    out = columns.copy()
    marked = np.nonzero(columns)[0]
    for a, b in pairwise(marked):
        if b - a <= gap + 1:
            out[a:b] = True
    return out


# Free space.


@dataclass(frozen=True)
class FreeSpace:
    """The levels that rays passed, a bit each, in cells (h, w) of CELL_M from `origin` (2,), and where the floor was seen (h, w)."""

    origin: F64
    levels: U32
    floor: Bool

    def at(self, points: F64) -> U32:
        """Return the levels (n,) at points (n, 2); none outside."""
        column, row = np.floor((points - self.origin) / CELL_M).astype(int).T
        h, w = self.levels.shape
        inside = (row >= 0) & (row < h) & (column >= 0) & (column < w)
        out = np.zeros(len(points), np.uint32)
        out[inside] = self.levels[row[inside], column[inside]]
        return out


BESIDE_M = 1.0  # on stairs


def free_space(evidence: Evidence, storey: Storey, margin_m: float = 0.5) -> FreeSpace:
    """Carve the rays of all views from within a storey, or BESIDE_M below or above it."""
    low = evidence.points[:, :2].min(axis=0) - margin_m
    w, h = np.ceil((evidence.points[:, :2].max(axis=0) + margin_m - low) / CELL_M).astype(int)
    once, twice = np.zeros((h, w), np.uint32), np.zeros((h, w), np.uint32)
    above = storey.ceiling_m if np.isfinite(storey.ceiling_m) else float("inf")
    for view, T in zip(evidence.views, evidence.poses):
        if not storey.bottom_m - BESIDE_M < T[2, 3] < above + BESIDE_M:
            continue
        carve_kernel(view.depth_m, view.camera.intrinsics, T, low, CELL_M, storey.bottom_m, LEVEL_M, 2, MARGIN, once, twice)
    floor = np.zeros((h, w), np.bool_)
    level = (evidence.normals[:, 2] > np.cos(np.radians(LEVEL_DEG))) & (np.abs(evidence.points[:, 2] - storey.bottom_m) < 0.1)
    column, row = np.floor((evidence.points[level, :2] - low) / CELL_M).astype(int).T
    floor[row, column] = True
    return FreeSpace(low, twice, floor)


def nothing(state: Gathered, note: str, T_world_building: F64 | None = None) -> Building:
    """Return the plan without elements, with the reason."""
    return Building.empty(state.index, state.stamp_ns, note, T_world_building)
