"""The bundle-adjustment problem of a window of keyframes: what is unknown, and what was measured of it, gathered from a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert, tangent_basis, transform_planes
from trihedron.pipeline.core.types import F64, I32, Correction, Map, Table
from trihedron.plugins.bundle.common_kernels import (
    HUBER,
    SQUARES,
    TRUNCATED,
    BundleMeasurements,
    BundleState,
    NormalEquations,
    landmark_steps,
    linearise_bundle,
    marginals,
    moved_bundle,
    reduce_bundle,
)
from trihedron.plugins.mapping.covisibility_graph import covisible_keyframes, newest_keyframes, observed_by
from trihedron.plugins.mapping.landmarks import ENDS, PLACE, places
from trihedron.plugins.shared.linalg import inverse, transform_plane_covariance
from trihedron.plugins.shared.linalg_kernels import solve_positive
from trihedron.plugins.shared.pose_optimizer_kernels import (
    PARALLEL,
    PERPENDICULAR,
)


@dataclass(frozen=True)
class BundleWindow:
    """Rows of the map: the keyframes that may move, those that are held, and the landmarks that the former see. Each sorted."""

    free: I32
    fixed: I32
    points: I32
    lines: I32
    planes: I32


def bundle_window(map: Map, free: int, fixed: int, least_fixed: int = 1) -> BundleWindow:
    """The newest keyframe and those that share most landmarks with it, at most `free`, held in place by at most `fixed` further ones that see the
    same landmarks. The first keyframe is the world and never moves; where fewer than `least_fixed` hold the window, its oldest keyframes do, which
    may leave nothing to move."""
    newest = newest_keyframes(map, 1)
    moving = np.sort(np.concatenate([newest, covisible_keyframes(map, newest, free - 1)]))
    held = covisible_keyframes(map, moving, fixed)
    while len(moving) and (len(held) < least_fixed or moving[0] == 0):
        held, moving = np.append(held, moving[:1]), moving[1:]
    points, lines, planes = (observed_by(map, moving, kind) for kind in ("point", "line", "plane"))
    return BundleWindow(moving, np.sort(held), points, lines, planes)


def bundle_problem(
    map: Map, window: BundleWindow, line_sigma_px: float = 1.0, relation_sigma_deg: float = 0.5, parallel_deg: float = 5.0
) -> tuple[BundleState, BundleMeasurements]:
    """The unknowns of the window at their places in the map, and all that its keyframes measured of its landmarks. Planes within `parallel_deg` of
    parallel or of a right angle are held to it to within `relation_sigma_deg`."""
    keyframes = np.concatenate([window.free, window.fixed])
    poses = map.keyframes.rows("T_world_camera", keyframes)
    state = BundleState(
        poses[:, :3, :3].copy(),
        poses[:, :3, 3].copy(),
        map.points.rows("position_m", window.points),
        map.lines.rows("endpoints_m", window.lines),
        map.planes.rows("coefficients", window.planes),
    )
    point_rows, point_keyframes, point_starts = _observations(map, "point", keyframes, window.points)
    line_rows, line_keyframes, line_starts = _observations(map, "line", keyframes, window.lines)
    plane_rows, plane_keyframes, plane_starts = _observations(map, "plane", keyframes, window.planes)
    relations, variance = _relations(state.planes, relation_sigma_deg, parallel_deg)
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
        line_sigma_px,
        plane_keyframes,
        np.repeat(np.arange(len(window.planes), dtype=np.int32), np.diff(plane_starts)),
        map.plane_observations.rows("coefficients", plane_rows),
        inverse(map.plane_observations.rows("covariance", plane_rows)),
        relations,
        variance,
        True,
    )


def _column(table: Table, name: str, rows: I32) -> F64:
    return np.asarray(table.rows(name, rows), np.float64)


def _observations(map: Map, kind: str, keyframes: I32, ids: I32) -> tuple[I32, I32, I32]:
    """Rows of the observation table in which the keyframes saw the landmarks, in the order of these; the place among the keyframes of each, and where
    each landmark's rows begin, (n + 1,)."""
    table: Table = getattr(map, f"{kind}_observations")
    spans = map.keyframes.rows(f"{kind}s", keyframes)
    rows = np.concatenate([np.empty(0, np.int32), *(np.arange(a, b, dtype=np.int32) for a, b in spans)])
    who = np.repeat(np.arange(len(keyframes), dtype=np.int32), spans[:, 1] - spans[:, 0])
    place = places(table.rows(kind, rows), ids)
    known = np.flatnonzero(place >= 0)
    place = place[known]
    short = place.astype(np.uint16) if len(ids) < 1 << 16 else place  # numbers of two bytes NumPy sorts in a third of the time
    order = known[np.argsort(short, kind="stable")]
    starts = np.concatenate([[0], np.cumsum(np.bincount(place, minlength=len(ids)))]).astype(np.int32)
    return rows[order], who[order], starts


def _relations(planes: F64, sigma_deg: float, parallel_deg: float) -> tuple[I32, F64]:
    """Pairs of planes that are parallel or at right angles, (s, 3), and the variance of each angle (rad²): walls deviate one by one, so a plane with
    k partners says as much as one of them in all."""
    cosine = np.abs(planes[:, :3] @ planes[:, :3].T)
    limit = np.radians(parallel_deg)
    related = np.triu((cosine > np.cos(limit)) | (cosine < np.sin(limit)), 1)
    a, b = np.nonzero(related)
    kinds = np.where(cosine[a, b] > 0.5, PARALLEL, PERPENDICULAR)
    partners = (related | related.T).sum(axis=1)
    variance = np.radians(sigma_deg) ** 2 * 0.5 * (partners[a] + partners[b])
    return np.stack([kinds, a, b], axis=-1).astype(np.int32), np.asarray(variance, np.float64)


# What a bundle adjustment found, as a correction of the map.

def bundle_correction(map: Map, window: BundleWindow, found: BundleSolution) -> Correction:
    """The window's keyframes and landmarks with the marginal information that all measurements of the window leave, poses uncertain too: later ones
    are fused on top of it, and the next adjustment begins again from the measurements themselves."""
    state, free, n = found.state, len(window.free), len(window.points)
    poses = np.tile(np.eye(4), (free, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = state.rotations[:free], state.positions[:free]
    points, ends = found.landmark_covariance[:n, :3, :3], _ends(map, window, state.lines, found.landmark_covariance[n:])
    planes = [found.covariance[i : i + 3, i : i + 3] for i in range(6 * free, len(found.covariance), 3)]
    return Correction(
        index=map.index,
        stamp_ns=map.stamp_ns,
        based_on=map.revision,
        keyframe_ids=window.free,
        T_world_keyframe=poses,
        point_ids=window.points,
        points_m=PLACE.rounded(state.points),
        point_information=_symmetric(inverse(points)).astype(np.float32),
        line_ids=window.lines,
        endpoints_m=ENDS.rounded(state.lines),
        line_information=_symmetric(inverse(ends)).astype(np.float32),
        plane_ids=window.planes,
        coefficients=state.planes,
        plane_covariance=_symmetric(np.array(planes, np.float64).reshape(-1, 3, 3)),
    )


def carried_correction(map: Map, window: BundleWindow, seen: BundleMeasurements, state: BundleState) -> Correction:
    """The window's keyframes and points where a state has them, known as well as the map knew them. Lines, planes and points that the state left in
    their places go with the newest free keyframe that saw them."""
    free = len(window.free)
    poses = np.tile(np.eye(4), (free, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = state.rotations[:free], state.positions[:free]
    motions = poses @ invert(map.keyframes.rows("T_world_camera", window.free))
    by = [np.repeat(np.arange(len(starts) - 1), np.diff(starts)) for starts in (seen.point_starts, seen.line_starts)]
    T_point, T_line, T_plane = (
        motions[_newest_free(rows, who, count, free)]
        for rows, who, count in (
            (by[0], seen.point_keyframes, len(window.points)),
            (by[1], seen.line_keyframes, len(window.lines)),
            (seen.plane_rows, seen.plane_keyframes, len(window.planes)),
        )
    )
    old = map.points.rows("position_m", window.points)
    still = (state.points == old).all(axis=1)
    points = np.where(still[:, None], _moved(T_point, old[:, None])[:, 0], state.points)
    planes = map.planes.rows("coefficients", window.planes)
    moved = [transform_planes(T, plane[None])[0] for T, plane in zip(T_plane, planes)]
    covariance = map.planes.rows("covariance", window.planes)
    turned = [transform_plane_covariance(T, a[None], b[None], C[None])[0] for T, a, b, C in zip(T_plane, planes, moved, covariance)]
    R, Q = T_point[:, :3, :3], T_line[:, None, :3, :3]
    return Correction(
        index=map.index,
        stamp_ns=map.stamp_ns,
        based_on=map.revision,
        keyframe_ids=window.free,
        T_world_keyframe=poses,
        point_ids=window.points,
        points_m=PLACE.rounded(points),
        point_information=(R @ map.points.rows("information", window.points) @ np.swapaxes(R, -1, -2)).astype(np.float32),
        line_ids=window.lines,
        endpoints_m=ENDS.rounded(_moved(T_line, map.lines.rows("endpoints_m", window.lines))),
        line_information=(Q @ map.lines.rows("information", window.lines) @ np.swapaxes(Q, -1, -2)).astype(np.float32),
        plane_ids=window.planes,
        coefficients=np.array(moved, np.float64).reshape(-1, 4),
        plane_covariance=np.array(turned, np.float64).reshape(-1, 3, 3),
    )


def _newest_free(rows: NDArray[np.signedinteger], keyframes: I32, count: int, free: int) -> I32:
    """(count,) the newest free keyframe among those, `keyframes`, that saw each landmark, `rows`; every one was seen by some."""
    newest = np.zeros(count, np.int32)
    known = keyframes < free
    np.maximum.at(newest, rows[known], keyframes[known])
    return newest


def _moved(T: F64, points: F64) -> F64:
    """Points (n, e, 3), each row by its own motion (n, 4, 4)."""
    return np.asarray(points @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3], np.float64)


def _ends(map: Map, window: BundleWindow, lines: F64, covariance: F64) -> F64:
    """(m, 2, 3, 3) covariance of the ends of lines (m, 2, 3): that found across them, (m, 4, 4), and along them what the map knew, for only where a
    line is was adjusted, not where it ends."""
    direction = lines[:, 1] - lines[:, 0]
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    known = inverse(map.lines.rows("information", window.lines))
    along = np.einsum("mi,meij,mj->me", direction, known, direction)
    N = tangent_basis(direction)
    across = np.stack([covariance[:, :2, :2], covariance[:, 2:, 2:]], axis=1)
    return N[:, None] @ across @ np.swapaxes(N, -1, -2)[:, None] + along[..., None, None] * (direction[:, :, None] * direction[:, None, :])[:, None]


def _symmetric(matrices: F64) -> F64:
    return 0.5 * (matrices + np.swapaxes(matrices, -1, -2))


# Bundle adjustment by Levenberg–Marquardt: keyframes, points, lines and planes at once, points and lines eliminated by the Schur complement.
#
# Triggs et al., "Bundle Adjustment – A Modern Synthesis", 2000. Planes stay with the poses in the reduced system: they are few, and the parallel and
# perpendicular ones are tied to each other.

DAMPING, MIN_DAMPING = 1e-4, 1e-9
CONVERGED = 1e-2  # squared length of a pose's or plane's step in standard deviations, on average over the unknowns


@dataclass(frozen=True)
class BundleSolution:
    """The state found, with its cost under the last loss. Covariances are marginal, given the held keyframes: (6 free + 3
    p, ...) of poses (xi) and planes (a, b, d), and (n + m, 4, 4) of points (the first three) and of lines in `line_basis` at both ends."""

    state: BundleState
    cost: float
    iterations: int
    covariance: F64
    landmark_covariance: F64


def solve_bundle(state: BundleState, seen: BundleMeasurements, iterations: int) -> BundleSolution:
    """Minimise the sum of all terms from `state`, with Huber's cost and then without the outliers, in at most so many steps each. Never raises: what
    nothing measures keeps its place, and the cost never grows."""
    losses = (HUBER, TRUNCATED) if seen.robust else (SQUARES,)
    now, trial = _empty(state, seen), _empty(state, seen)
    S, y, inverses = np.empty(now.H.shape), np.empty(len(now.g)), np.empty_like(now.V)
    used, cost = 0, 0.0
    for loss in losses:
        state, cost, steps, now, trial = _minimised(state, seen, loss, iterations, now, trial, loss == losses[-1])
        used += steps
    reduce_bundle(now, seen, 0.0, S, y, inverses)
    covariance = inverse(S)
    landmarks = np.empty_like(now.V)
    marginals(now, seen, inverses, covariance, landmarks)
    return BundleSolution(state, cost, used, covariance, landmarks)


def _minimised(
    state: BundleState, seen: BundleMeasurements, loss: int, iterations: int, now: NormalEquations, trial: NormalEquations, last: bool
) -> tuple[BundleState, float, int, NormalEquations, NormalEquations]:
    """Levenberg–Marquardt under one loss. Returns the state, its cost, the steps tried and the room for the normal equations, after the `last` loss
    those at the state first; before it they are not needed any more."""
    cost = linearise_bundle(state, seen, loss, now, True)
    S, y, inverses = np.empty(now.H.shape), np.empty(len(now.g)), np.empty_like(now.V)
    dx, steps, damping = np.empty(len(now.g)), np.empty((len(now.V), 4)), DAMPING
    for used in range(iterations):
        reduce_bundle(now, seen, damping, S, y, inverses)
        if not solve_positive(S, y, dx):
            damping *= 10.0
            continue
        landmark_steps(now, seen, inverses, dx, steps)
        moved = moved_bundle(state, seen.free, dx, steps)
        length = float(dx @ S @ dx) / max(len(dx), 1)
        new = linearise_bundle(moved, seen, loss, trial, last or not length < CONVERGED)
        if new < cost:
            state, cost, damping = moved, new, max(0.1 * damping, MIN_DAMPING)
            now, trial = trial, now
        else:
            damping *= 10.0
        if length < CONVERGED:
            return state, float(cost), used + 1, now, trial
    return state, float(cost), iterations, now, trial


def _empty(state: BundleState, seen: BundleMeasurements) -> NormalEquations:
    """Room for the normal equations."""
    dense, landmarks = 6 * seen.free + 3 * len(state.planes), len(state.points) + len(state.lines)
    observations = len(seen.point_keyframes) + len(seen.line_keyframes)
    return NormalEquations(
        np.empty((dense, dense)), np.empty(dense), np.empty((landmarks, 4, 4)), np.empty((landmarks, 4)), np.empty((observations, 6, 4))
    )
