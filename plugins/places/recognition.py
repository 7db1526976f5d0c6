"""Where in the map a frame could be, by what its features look like: no pose is needed, and none is found here."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, I32, U8, Keypoints, Map, Segments
from trihedron.plugins.mapping.covisibility_graph import WEIGHTS, observed_by
from trihedron.plugins.places.recognition_kernels import consensus, lookalikes_kernel
from trihedron.plugins.shared.descriptors import words_of


def lookalikes(query: U8, train: U8, max_bits: int, ratio: float) -> I32:
    """For each of n described things (n, bytes) the row of the m known ones (m, bytes) that looks most like it, or -1: at most `max_bits` away, and
    less than `ratio` × the second best (1 or more: no such test)."""
    return lookalikes_kernel(words_of(query)[0], words_of(train)[0], max_bits, ratio)


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
    poses, support = consensus(camera_m, world_m, 3.0 * sigma_m, draws)
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
