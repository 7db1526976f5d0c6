"""Where in the map a frame could be, by what its features look like: no pose is needed, and none is found here."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, U8, Keypoints, Map, Segments
from trihedron.plugins.numerics.algebra.small_linear import polar_rotation
from trihedron.plugins.numerics.images.descriptors import U64, hamming, words_of
from trihedron.plugins.numerics.maps.local_window import WEIGHTS, observed_by


def lookalikes(query: U8, train: U8, max_bits: int, ratio: float) -> I32:
    """For each of n described things (n, bytes) the row of the m known ones (m, bytes) that looks most like it, or -1: at most `max_bits` away, and
    less than `ratio` × the second best (1 or more: no such test)."""
    return _lookalikes(words_of(query)[0], words_of(train)[0], max_bits, ratio)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lookalikes(query: U64, train: U64, max_bits: int, ratio: float) -> I32:
    out = np.full(len(query), -1, np.int32)
    for i in range(len(query)):
        best, second, row = 1 << 30, 1 << 30, -1
        for j in range(len(train)):
            bits = hamming(query[i], train[j])
            if bits < best:
                best, second, row = bits, best, j
            elif bits < second:
                second = bits
        if best <= max_bits and (ratio >= 1.0 or best < ratio * second):
            out[i] = row
    return out


def likely_keyframes(map: Map, keypoints: Keypoints, segments: Segments, among: I32, count: int, max_bits: int) -> I32:
    """Of the keyframes `among`, sorted, the `count` that saw most of what looks like this frame's points and lines; all when they are no more."""
    if len(among) <= count:
        return among
    votes = np.zeros(len(map.keyframes), np.int64)
    for kind, found, weight in (("point", keypoints, 1), ("line", segments, WEIGHTS["line"])):
        ids = observed_by(map, among, kind)
        table = getattr(map, f"{kind}s")
        rows = lookalikes(found.descriptors, table.rows("descriptor", ids), max_bits, 1.0)
        observers = table.rows("observers", ids[np.unique(rows[rows >= 0])])
        votes += weight * np.bincount(observers[observers >= 0], minlength=len(votes))
    order = among[np.argsort(-votes[among], kind="stable")]
    return np.sort(order[:count]).astype(np.int32)


def block_of(keyframes: I32, size: int, number: int) -> I32:
    """The `number`-th block of `size` keyframes, modulo their count, each half of it shared with the next: a large map is looked through block by
    block, so that one frame's time is bounded."""
    if len(keyframes) <= size:
        return keyframes
    starts = np.arange(0, len(keyframes) - size // 2, size // 2)
    start = min(int(starts[number % len(starts)]), len(keyframes) - size)
    return keyframes[start : start + size]


def rigid_hypotheses(camera_m: F64, world_m: F64, sigma_m: F64, draws: I32, count: int) -> F64:
    """(k, 4, 4), k <= count, poses `T_world_camera` by three points each (Procrustes), those that most of the n pairs of places (n, 3) agree with;
    `sigma_m` (n,) is the error of each pair, `draws` (m, 3) the triples to try. No two are alike, the best is first."""
    poses, support = _consensus(camera_m, world_m, 3.0 * sigma_m, draws)
    order = np.argsort(-support, kind="stable")
    return distinct(poses[order[support[order] >= 6]], count)


def distinct(poses: F64, count: int) -> F64:
    """The first `count` of the poses (n, 4, 4) that differ from each before by 10 cm or 5°."""
    kept: list[F64] = []
    for T in poses:
        if len(kept) == count:
            break
        if all(apart(T, other) for other in kept):
            kept.append(T)
    return np.array(kept).reshape(-1, 4, 4)


def apart(T: F64, other: F64) -> bool:
    """Whether two poses are two places: 10 cm or 5° apart."""
    cosine = 0.5 * (np.trace(T[:3, :3].T @ other[:3, :3]) - 1.0)
    return bool(np.linalg.norm(T[:3, 3] - other[:3, 3]) > 0.1 or cosine < np.cos(np.radians(5.0)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _as_long(camera_m: F64, world_m: F64, limit: F64, i: int, j: int) -> bool:
    """Whether two pairs of places are as far apart here as there, and far enough to tell a direction."""
    here, there = 0.0, 0.0
    for r in range(3):
        here += (camera_m[i, r] - camera_m[j, r]) ** 2
        there += (world_m[i, r] - world_m[j, r]) ** 2
    return here > 0.1**2 and abs(np.sqrt(here) - np.sqrt(there)) <= limit[i] + limit[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _consensus(camera_m: F64, world_m: F64, limit: F64, draws: I32) -> tuple[F64, I32]:
    """Pose and number of agreeing pairs of each draw; 0 for one whose triangles differ."""
    poses, support = np.zeros((len(draws), 4, 4)), np.zeros(len(draws), np.int32)
    M, p, q, t = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(draws)):
        a, b, c = draws[k, 0], draws[k, 1], draws[k, 2]
        if a in (b, c) or b == c:
            continue
        if not (_as_long(camera_m, world_m, limit, a, b) and _as_long(camera_m, world_m, limit, b, c) and _as_long(camera_m, world_m, limit, c, a)):
            continue
        for r in range(3):
            p[r] = (camera_m[a, r] + camera_m[b, r] + camera_m[c, r]) / 3.0
            q[r] = (world_m[a, r] + world_m[b, r] + world_m[c, r]) / 3.0
        for r in range(3):
            for s in range(3):
                M[r, s] = 0.0
                for i in (a, b, c):
                    M[r, s] += (world_m[i, r] - q[r]) * (camera_m[i, s] - p[s])
        R = polar_rotation(M)
        for r in range(3):
            t[r] = q[r] - (R[r, 0] * p[0] + R[r, 1] * p[1] + R[r, 2] * p[2])
        for i in range(len(camera_m)):
            square = 0.0
            for r in range(3):
                e = R[r, 0] * camera_m[i, 0] + R[r, 1] * camera_m[i, 1] + R[r, 2] * camera_m[i, 2] + t[r] - world_m[i, r]
                square += e * e
            support[k] += square <= limit[i] * limit[i]
        for r in range(3):
            poses[k, r, 3] = t[r]
            for s in range(3):
                poses[k, r, s] = R[r, s]
        poses[k, 3, 3] = 1.0
    return poses, support
