"""Which Manhattan frame is which from image to image."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.axes.cube_symmetry import CUBE

FURTHEST = np.cos(np.radians(63.0))  # two frames are at most 62.8° apart under the nearest of their names


def symmetric_angles(found: F64, known: F64) -> F64:
    """(f, k) angles (rad) between rotations (f, 3, 3) and (k, 3, 3), each pair under the nearest of its 24 names."""
    between = np.einsum("fji,kjl->fkil", found, known)
    trace = np.einsum("fkij,nji->fkn", between, CUBE).max(axis=2)
    return np.asarray(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))


def identified(found: F64, expected: F64, limit: float) -> I32:
    """(f,) row of the expected frame (k, 3, 3) that each found one (f, 3, 3) is, -1 for none; nearest pairs first, none further than `limit` rad."""
    rows = np.full(len(found), -1, np.int32)
    angles = symmetric_angles(found, expected)
    while angles.size and angles.min() <= limit:
        f, k = np.unravel_index(int(np.argmin(angles)), angles.shape)
        rows[f] = k
        angles[f], angles[:, k] = np.inf, np.inf
    return rows


def turn_between(found: F64, before: F64, limit: float) -> F64:
    """(3, 3) turn Q of the camera after which most of the frames `before` (k, 3, 3) are found (f, 3, 3) again within `limit` rad, the smallest of
    these turns: frames keep their angles to each other when the camera jumps. The identity when there are none."""
    best, turn = (0, -1.0), np.eye(3)
    for one in found:
        for known in before:
            for name in CUBE:
                Q = one @ name @ known.T
                cosine = 0.5 * (np.trace(Q) - 1.0)
                if cosine < FURTHEST:  # some name is nearer
                    continue
                rank = (int((identified(found, Q @ before, limit) >= 0).sum()), cosine)
                if rank > best:
                    best, turn = rank, Q
    return turn


def missing(rows: I32, count: int) -> I32:
    """Those of `count` rows that are not among `rows`."""
    left = np.ones(count, np.bool_)
    left[rows[rows >= 0]] = False
    return np.flatnonzero(left).astype(np.int32)


def remembered(unseen: I32, ids: I32, room: int) -> I32:
    """Of the rows of frames out of sight those for which there is room: seen last, and the one with the highest id, so that no id is given twice."""
    if len(unseen) <= max(room, 0):
        return unseen
    newest = unseen[ids[unseen] == ids.max()]
    return np.sort(np.concatenate([unseen[ids[unseen] != ids.max()][: max(room - len(newest), 0)], newest]))
