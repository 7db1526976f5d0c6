"""Loop closing by appearance: a bag of binary words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import PositiveInt, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, U8, Correction, Frame, Map
from trihedron.plugins.loop.common_loop_verification import LoopOptions, close_loop, path_lengths, within_reach
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.shared.feature_matching import words_of
from trihedron.plugins.shared.feature_matching_kernels import U64, nearest_descriptors


@register("loop", "appearance")
@dataclass(frozen=True)
class AppearanceLoop(LoopOptions):
    """Recognise a place by a bag of binary words, trained on the keyframes that are compared: nothing is downloaded.

    A keyframe is a candidate when its similarity is a share of that of the newest keyframe and its predecessor (DBoW2: Gálvez-López and Tardós, T-RO
    2012): the L1 distance of normalised tf-idf vectors. Every candidate is verified with points, lines and planes and by free space; the correction
    is that of a pose graph. A scene without points has no words."""

    words: PositiveInt = 256
    rounds: PositiveInt = 2  # of the training
    training: PositiveInt = 4000  # most descriptors it uses
    context: PositiveInt = 30  # other keyframes, spread over the run, that say which words are common
    looked_at: PositiveInt = 20  # keyframes within reach that are compared, the nearest first
    min_likeness: Share = 0.3  # share of the predecessor's likeness

    def __call__(self, map: Map, frame: Frame) -> Correction | None:
        """Return the correction; None unless the newest keyframe closes a loop, or the map has rotated out of its Manhattan frame."""
        return close_loop(self, self._rank, map, frame)

    def _rank(self, map: Map) -> Iterator[tuple[int, float]]:
        """Keyframes within reach, the most similar first, with the length of the path since."""
        rows, path_m = within_reach(self, map, self.looked_at)
        living, _ = path_lengths(map)
        if not len(rows) or len(living) < 2:
            return
        spread = living[np.linspace(0, len(living) - 1, min(self.context, len(living))).round().astype(int)]
        ids = [observed_by(map, np.array([row], np.int32), "point") for row in (*spread, living[-2], *rows, living[-1])]
        similarity = self._similarities(map, ids)[len(spread) :]
        for k in np.argsort(-similarity[1:], kind="stable"):
            if similarity[1 + k] >= self.min_likeness * similarity[0] and similarity[1 + k] > 0.0:
                yield int(rows[k]), float(path_m[k])

    def _similarities(self, map: Map, ids: list[I32]) -> F64:
        """Similarity of the last of some sets of points to each of the others."""
        known = np.unique(np.concatenate(ids)).astype(np.int32)
        if not len(known):
            return np.zeros(len(ids) - 1)
        bits = as_bits(map.points.rows("descriptor", known))
        chosen = np.linspace(0, len(bits) - 1, min(self.training, len(bits))).round().astype(int)
        vocabulary = train(bits[chosen], self.words, self.rounds)
        words = nearest_words(bits, vocabulary)
        return similarities([words[np.searchsorted(known, one)] for one in ids], len(vocabulary))


HISTOGRAM = 128  # least bytes of a histogram (SIFT) or learned descriptor: its bits are those above the median


def as_bits(descriptors: U8) -> U64:
    """Convert descriptors (n, b) to machine words of bits (n, w)."""
    if descriptors.shape[1] >= HISTOGRAM:
        descriptors = np.packbits(descriptors > np.median(descriptors, axis=1, keepdims=True), axis=1)
    return words_of(descriptors)[0]


def nearest_words(bits: U64, vocabulary: U64) -> I32:
    """Return the row (n,) of the nearest word of each descriptor, the first of equally near ones."""
    return nearest_descriptors(bits, vocabulary, 64 * bits.shape[1], 1.0)


def train(bits: U64, words: int, rounds: int) -> U64:
    """Train a vocabulary (k, w) of at most `words` on descriptors (n, w) by k-majority clustering (Grana et al. 2013), from evenly chosen ones."""
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
    return np.asarray(vocabulary)


def similarities(bags: list[I32], words: int) -> F64:
    """Return the similarity (m - 1,) of the last of m bags of words to each other one: 1 for the same words, 0 for none in common."""
    counts = np.array([np.bincount(bag, minlength=words) for bag in bags], np.float64).reshape(len(bags), words)
    idf = np.log(len(bags) / np.maximum(np.count_nonzero(counts, axis=0), 1))
    weighed = counts * np.maximum(idf, 1e-6)
    weighed /= np.maximum(weighed.sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(1.0 - 0.5 * np.abs(weighed[:-1] - weighed[-1]).sum(axis=1))
