"""Loops found by what the points look like."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import PositiveInt, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, U8, Map
from trihedron.plugins.loop.appearance_kernels import U64, nearest_words
from trihedron.plugins.loop.common import LoopClosing, walked, within_reach
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.shared.descriptors import words_of


@register("loop", "appearance")
@dataclass(frozen=True)
class AppearanceLoop(LoopClosing):
    """Recognise a place by a bag of binary words, trained on the keyframes that are compared: nothing is downloaded.

    A keyframe is a candidate when it is as alike as a share of what the newest keyframe and its predecessor have in common (DBoW2). Every candidate
    is verified with points, lines and planes and by free space; the correction is that of a pose graph. A scene without points has no words."""

    words: PositiveInt = 256
    rounds: PositiveInt = 2  # of the training
    training: PositiveInt = 4000  # most descriptors it uses
    context: PositiveInt = 30  # other keyframes, spread over the run, that say which words are common
    looked_at: PositiveInt = 20  # keyframes within reach that are compared, the nearest first
    min_likeness: Share = 0.3  # share of the predecessor's likeness

    def ranked(self, map: Map) -> Iterator[tuple[int, float]]:
        """Keyframes within reach, the most alike first, with the way walked since."""
        rows, way = within_reach(map, self.reach)
        rows, way = rows[: self.looked_at], way[: self.looked_at]
        living, _ = walked(map)
        if not len(rows) or len(living) < 2:
            return
        spread = living[np.linspace(0, len(living) - 1, min(self.context, len(living))).round().astype(int)]
        ids = [observed_by(map, np.array([row], np.int32), "point") for row in (*spread, living[-2], *rows, living[-1])]
        alike = self._likeness(map, ids)[len(spread) :]
        for k in np.argsort(-alike[1:], kind="stable"):
            if alike[1 + k] >= self.min_likeness * alike[0] and alike[1 + k] > 0.0:
                yield int(rows[k]), float(way[k])

    def _likeness(self, map: Map, ids: list[I32]) -> np.ndarray:
        """How alike the last of some sets of points is to each of the others."""
        known = np.unique(np.concatenate(ids)).astype(np.int32)
        if not len(known):
            return np.zeros(len(ids) - 1)
        bits = as_bits(map.points.rows("descriptor", known))
        chosen = np.linspace(0, len(bits) - 1, min(self.training, len(bits))).round().astype(int)
        vocabulary = train(bits[chosen], self.words, self.rounds)
        words = nearest_words(bits, vocabulary)
        return similarities([words[np.searchsorted(known, one)] for one in ids], len(vocabulary))


HISTOGRAM = 128  # bytes: a descriptor this long is a histogram (SIFT), and its bits are the bins above the median


def as_bits(descriptors: U8) -> U64:
    """(n, b) descriptors -> (n, w) machine words of bits."""
    if descriptors.shape[1] == HISTOGRAM:
        descriptors = np.packbits(descriptors > np.median(descriptors, axis=1, keepdims=True), axis=1)
    return words_of(descriptors)[0]


def train(bits: U64, words: int, rounds: int) -> U64:
    """(k, w) vocabulary of at most `words` from (n, w) descriptors: evenly chosen ones, then rounds of assignment and majority. Deterministic."""
    chosen = np.unique(np.linspace(0, len(bits) - 1, min(words, len(bits))).round().astype(int))
    vocabulary = bits[chosen]
    single = np.unpackbits(bits.view(np.uint8), axis=1)
    for _ in range(rounds):
        nearest = nearest_words(bits, vocabulary)
        members = np.bincount(nearest, minlength=len(vocabulary))
        votes = np.zeros((len(vocabulary), single.shape[1]), np.int64)
        np.add.at(votes, nearest, single)
        majority = np.packbits(2 * votes > members[:, None], axis=1).view(np.uint64)
        vocabulary = np.where(members[:, None] > 0, majority, vocabulary)
    return vocabulary


def similarities(bags: list[I32], words: int) -> F64:
    """(m - 1,) how alike the last of m bags of words is to each other one: 1 for the same words, 0 for none in common."""
    counts = np.array([np.bincount(bag, minlength=words) for bag in bags], np.float64).reshape(len(bags), words)
    idf = np.log(len(bags) / np.maximum(np.count_nonzero(counts, axis=0), 1))
    weighed = counts * np.maximum(idf, 1e-6)
    weighed /= np.maximum(weighed.sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(1.0 - 0.5 * np.abs(weighed[:-1] - weighed[-1]).sum(axis=1))
