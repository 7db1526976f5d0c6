"""Several Manhattan frames: their association from image to image, and the result of an estimator that knows several."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import nearest_rotation
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.manhattan.axis_fit import fit_axes
from trihedron.plugins.manhattan.axis_fit_kernels import NOTHING_KNOWN, FitRules, orthonormal
from trihedron.plugins.manhattan.modes import Modes, mode_spread
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE

FURTHEST = np.cos(np.radians(63.0))  # two frames are at most 62.8° apart under the nearest of their names


def symmetric_angles(found: F64, known: F64) -> F64:
    """Return the angles (f, k) in rad between rotations (f, 3, 3) and (k, 3, 3), each pair under the nearest of its 24 names."""
    between = np.einsum("fji,kjl->fkil", found, known)
    trace = np.einsum("fkij,nji->fkn", between, CUBE).max(axis=2)
    return np.asarray(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))


def associate_frames(found: F64, expected: F64, limit: float) -> I32:
    """Return the row (f,) of the expected frame (k, 3, 3) that each found one (f, 3, 3) is, -1 for none: nearest pairs first,
    none further than `limit` rad."""
    rows = np.full(len(found), -1, np.int32)
    angles = symmetric_angles(found, expected)
    while angles.size and angles.min() <= limit:
        f, k = np.unravel_index(int(np.argmin(angles)), angles.shape)
        rows[f] = k
        angles[f], angles[:, k] = np.inf, np.inf
    return rows


def camera_rotation(found: F64, before: F64, limit: float) -> F64:
    """Return the rotation Q (3, 3) of the camera after which most of the frames `before` (k, 3, 3) are found (f, 3, 3) again within `limit`
    rad, the smallest of these rotations: frames keep their angles to each other when the camera jumps. The identity when there are none."""
    best, rotation = (0, -1.0), np.eye(3)
    for one in found:
        for known in before:
            for name in CUBE:
                Q = matmul(one, name, known.T)
                cosine = 0.5 * (np.trace(Q) - 1.0)
                if cosine < FURTHEST:  # some name is nearer
                    continue
                rank = (int((associate_frames(found, matmul(Q, before), limit) >= 0).sum()), cosine)
                if rank > best:
                    best, rotation = rank, Q
    return rotation


def unmatched_rows(rows: I32, count: int) -> I32:
    """Return the rows of `count` that are not in `rows`."""
    left = np.ones(count, np.bool_)
    left[rows[rows >= 0]] = False
    return np.flatnonzero(left).astype(np.int32)


def retain_unseen(unseen: I32, ids: I32, room: int) -> I32:
    """Return the rows of frames out of sight for which there is room: those seen last, and the one with the highest id, so that no
    id is given twice."""
    if len(unseen) <= max(room, 0):
        return unseen
    newest = unseen[ids[unseen] == ids.max()]
    return np.sort(np.concatenate([unseen[ids[unseen] != ids.max()][: max(room - len(newest), 0)], newest]))


# The slot's value: the frames in view, then those known but out of sight.


def lost_frames(modes: Modes, rules: FitRules, segments: Segments, planes: Planes, normals: Normals, known: F64, ids: I32) -> ManhattanFrame:
    """Manhattan frames that are not supported: a single axis of the first still rotates all that are known (k, 3, 3), and measures two of its three
    angles.

    The known ones are rotated by `R · known[0]ᵀ`, which triples their rounding error; each is replaced by the nearest rotation, since a scene may
    show no frame for hundreds of images."""
    R, covariance = known[0], np.eye(3) * NOTHING_KNOWN
    if modes.seen.sum() == 1:
        rotated = orthonormal(modes.axes, np.where(modes.seen, 1.0, 1e-6))
        R, covariance = fit_axes(rules, rotated, modes.axes, modes.normals, modes.seen, segments, planes)
    count, spread = len(known), np.full((len(known), 3), np.nan)
    spread[0] = mode_spread(modes)
    inliers = np.zeros((count, 3), np.int32)
    inliers[0] = np.where(modes.seen, modes.normals[:, 0] + modes.lines[:, 0], 0)
    return ManhattanFrame(
        index=normals.index,
        stamp_ns=normals.stamp_ns,
        rotations=np.array([nearest_rotation(rotation) for rotation in matmul(R, known[0].T, known)]),
        ids=ids,
        covariance=np.concatenate([covariance[None], np.tile(np.eye(3) * NOTHING_KNOWN, (count - 1, 1, 1))]),
        inliers=inliers,
        spread=spread,
        supported=False,
    )


def seen_frames(
    normals: Normals, rotations: F64, covariance: F64, inliers: F64, spread: F64, rows: I32, ids: I32, unseen: I32, expected: F64
) -> ManhattanFrame:
    """The frames seen, (k, 3, 3) with their covariances, inliers (k, 3) and spread (k, 3), then those out of sight, where they are `expected`
    (u, 3, 3): without inliers, with an uninformative covariance.

    `rows` (k,) and `unseen` (u,) say which of the known frames, with `ids`, they are; -1 is a new one and gets a number of its own."""
    nothing = np.zeros((len(unseen), 3))
    return ManhattanFrame(
        index=normals.index,
        stamp_ns=normals.stamp_ns,
        rotations=np.concatenate([rotations, expected.reshape(-1, 3, 3)]),
        ids=np.concatenate([np.where(rows >= 0, ids[rows], ids.max() + np.cumsum(rows < 0)), ids[unseen]]).astype(np.int32),
        covariance=np.concatenate([covariance, np.tile(np.eye(3) * NOTHING_KNOWN, (len(unseen), 1, 1))]),
        inliers=np.concatenate([inliers, nothing]).astype(np.int32),
        spread=np.concatenate([spread, nothing * np.nan]),
        supported=True,
    )
