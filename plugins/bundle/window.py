"""The bundle-adjustment problem of a window of keyframes: its parameters and their observations, gathered from the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from trihedron.pipeline.core.linalg import inv_symmetric, matmul
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.types import F64, I32, Map, Table
from trihedron.plugins.mapping.covisibility_graph import covisible_keyframes, current_submap, keyframes_of, newest_keyframes, observed_by, odometry
from trihedron.plugins.mapping.landmark_kinds import KINDS, LINE, PLANE, POINT, LandmarkKind, observed_rows
from trihedron.plugins.mapping.landmarks import index_of, isin
from trihedron.plugins.shared.residuals_kernels import PARALLEL, PERPENDICULAR


class BundleState(NamedTuple):
    """The parameters: k keyframes (`T_world_camera`), n points, m lines by two points each, p planes, all in the world."""

    rotations: F64  # (k, 3, 3)
    positions: F64  # (k, 3)
    points: F64  # (n, 3)
    lines: F64  # (m, 2, 3)
    planes: F64  # (p, 4)


class BundleMeasurements(NamedTuple):
    """Observations by the keyframes. Those of points and lines are in the order of their landmarks: point i has the rows
    `point_starts[i]` to `point_starts[i + 1]`. Keyframes, points, lines and planes are numbered by their rows in the state."""

    free: int  # the first `free` keyframes are adjusted, the others are fixed
    intrinsics: F64  # (k, 4) fx, fy, cx, cy
    point_starts: I32  # (n + 1,)
    point_keyframes: I32  # (o,)
    pixels: F64  # (o, 2)
    depth_m: F64  # (o,) NaN = none
    sigma_px: F64  # (o,)
    sigma_m: F64  # (o,)
    line_starts: I32  # (m + 1,)
    line_keyframes: I32  # (q,)
    endpoints_px: F64  # (q, 2, 2)
    observed_m: F64  # (q, 2, 3) camera, NaN = none
    observed_covariance_m2: F64  # (q, 2, 3, 3)
    line_sigma_px: float
    plane_keyframes: I32  # (r,)
    plane_landmarks: I32  # (r,)
    observed_planes: F64  # (r, 4) camera
    plane_information: F64  # (r, 3, 3) of (a, b, d)
    relations: I32  # (s, 3): PARALLEL or PERPENDICULAR, and two planes
    relation_variance: F64  # (s,) rad²
    neighbours: I32  # (e, 2) keyframes a and b, neighbours in time
    motions: F64  # (e, 4, 4) T_a_b by tracking
    motion_information: F64  # (e, 6, 6) of xi in `T_a_b · Exp(xi)`
    robust: bool  # Huber's loss beyond the 95 % gates, then rejection of points and lines beyond them; False: least squares


@dataclass(frozen=True)
class WindowOptions:
    """Options of the window of keyframes."""

    keyframes: PositiveInt = 8  # at most, that are adjusted: the newest and the most covisible
    fixed: NonNegativeInt = 8  # at most, that are fixed


@dataclass(frozen=True)
class BundleOptions(WindowOptions):
    """Options of the residuals."""

    line_sigma_px: PositiveFloat = 1.0  # of a segment's end point across it, as in the map
    relation_sigma_deg: PositiveFloat = 0.5  # walls are parallel or perpendicular to within this
    parallel_deg: Annotated[float, Range(above=0, below=45)] = 5.0  # planes nearer to parallel, or to a right angle, are constrained to it
    drift_share: PositiveFloat = 0.01  # of the motion between neighbours in time, per root metre
    rotation_drift_deg: PositiveFloat = 0.05  # likewise


@dataclass(frozen=True)
class BundleWindow:
    """Rows of the map, each sorted: the adjusted and the fixed keyframes, and the landmarks that the former observe."""

    free: I32
    fixed: I32
    points: I32
    lines: I32
    planes: I32


def free_poses(state: BundleState, free: int) -> F64:
    """Poses `T_world_camera` (free, 4, 4) of the adjusted keyframes."""
    poses = np.tile(np.eye(4), (free, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = state.rotations[:free], state.positions[:free]
    return poses


def bundle_window(options: WindowOptions, map: Map, least_fixed: int = 1) -> BundleWindow:
    """Select the newest keyframe and the most covisible ones, and further keyframes, fixed ones: the newest of all others, with which odometry
    connects those after it, and the ones that observe most of the same landmarks.

    The first keyframe defines the world and is always fixed. With fewer than `least_fixed` fixed keyframes the oldest of the window are fixed too,
    which may leave none to adjust."""
    newest = newest_keyframes(map, 1)
    shared = covisible_keyframes(map, newest, options.keyframes - 1)
    moving = np.sort(np.concatenate([newest, shared]))
    held = covisible_keyframes(map, moving, options.fixed)
    if len(shared):
        others = keyframes_of(map, current_submap(map))
        before = others[~isin(others, moving)][-1:]
        held = np.concatenate([before, held[~isin(held, before)]])[: options.fixed]
    while len(moving) and (len(held) < least_fixed or moving[0] == 0):
        held, moving = np.append(held, moving[:1]), moving[1:]
    points, lines, planes = (observed_by(map, moving, kind) for kind in KINDS)
    return BundleWindow(moving, np.sort(held), points, lines, planes)


def bundle_problem(options: BundleOptions, map: Map, window: BundleWindow) -> tuple[BundleState, BundleMeasurements]:
    """Gather the initial state of the window from the map, and all observations of its landmarks by its keyframes."""
    keyframes = np.concatenate([window.free, window.fixed])
    poses = map.keyframes.rows("T_world_camera", keyframes)
    state = BundleState(
        poses[:, :3, :3].copy(),
        poses[:, :3, 3].copy(),
        map.points.rows("position_m", window.points),
        map.lines.rows("endpoints_m", window.lines),
        map.planes.rows("coefficients", window.planes),
    )
    point_rows, point_keyframes, point_starts = _observations(map, POINT, keyframes, window.points)
    line_rows, line_keyframes, line_starts = _observations(map, LINE, keyframes, window.lines)
    plane_rows, plane_keyframes, plane_starts = _observations(map, PLANE, keyframes, window.planes)
    relations, variance = _relations(options, state.planes)
    neighbours = _neighbours(map, keyframes, len(window.free))
    return state, BundleMeasurements(
        len(window.free),
        map.keyframes.rows("intrinsics", keyframes),
        point_starts,
        point_keyframes,
        _column(map.point_observations, "pixel", point_rows),
        _column(map.point_observations, "depth_m", point_rows),
        _column(map.point_observations, "sigma_px", point_rows),
        _column(map.point_observations, "sigma_m", point_rows),
        line_starts,
        line_keyframes,
        _column(map.line_observations, "endpoints_px", line_rows),
        _column(map.line_observations, "endpoints_m", line_rows),
        _column(map.line_observations, "covariance_m2", line_rows),
        options.line_sigma_px,
        plane_keyframes,
        np.repeat(np.arange(len(window.planes), dtype=np.int32), np.diff(plane_starts)),
        map.plane_observations.rows("coefficients", plane_rows),
        inv_symmetric(map.plane_observations.rows("covariance", plane_rows)),
        relations,
        variance,
        neighbours,
        *odometry(options, map, keyframes[neighbours]),
        True,
    )


def _neighbours(map: Map, keyframes: I32, free: int) -> I32:
    """(e, 2) the keyframes between which no other living one was made, the earlier first, at least one of them free; numbered as in the state."""
    living = keyframes_of(map, current_submap(map))
    place = np.full(len(map.keyframes), -1, np.int32)
    place[keyframes] = np.arange(len(keyframes), dtype=np.int32)
    pairs = np.stack([place[living[:-1]], place[living[1:]]], axis=1)
    return np.ascontiguousarray(pairs[(pairs >= 0).all(axis=1) & (pairs < free).any(axis=1)])


def _column(table: Table, name: str, rows: I32) -> F64:
    return np.asarray(table.rows(name, rows), np.float64)


def _observations(map: Map, kind: LandmarkKind, keyframes: I32, ids: I32) -> tuple[I32, I32, I32]:
    """Rows of the observation table of these keyframes and landmarks, ordered by landmark; the index among `keyframes` of each; and where each
    landmark's rows begin, (n + 1,)."""
    rows, observed, counts = observed_rows(map, keyframes, kind)
    who = np.repeat(np.arange(len(keyframes), dtype=np.int32), counts)
    place = index_of(observed, ids)
    known = np.flatnonzero(place >= 0)
    place = place[known]
    short = place.astype(np.uint16) if len(ids) < 1 << 16 else place  # numbers of two bytes NumPy sorts in a third of the time
    order = known[np.argsort(short, kind="stable")]
    starts = np.concatenate([[0], np.cumsum(np.bincount(place, minlength=len(ids)))]).astype(np.int32)
    return rows[order], who[order], starts


def _relations(options: BundleOptions, planes: F64) -> tuple[I32, F64]:
    """Pairs of planes that are parallel or perpendicular, (s, 3), and the variance of each angle (rad²).

    Walls deviate one by one, so the k relations of a plane count as one in total."""
    cosine = np.abs(matmul(planes[:, :3], planes[:, :3].T))
    limit = np.radians(options.parallel_deg)
    related = np.triu((cosine > np.cos(limit)) | (cosine < np.sin(limit)), 1)
    a, b = np.nonzero(related)
    kinds = np.where(cosine[a, b] > 0.5, PARALLEL, PERPENDICULAR)
    partners = (related | related.T).sum(axis=1)
    variance = np.radians(options.relation_sigma_deg) ** 2 * 0.5 * (partners[a] + partners[b])
    return np.stack([kinds, a, b], axis=-1).astype(np.int32), np.asarray(variance, np.float64)
