"""Loop closing by appearance: a bag of binary words."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import I32, U8, Correction, Frame, Map
from trihedron.plugins.loop.loop_closing import close_loop
from trihedron.plugins.loop.tf_idf_ranking import HISTOGRAM, WordOptions, rank_by_words
from trihedron.plugins.shared.feature_matching import words_of
from trihedron.plugins.shared.feature_matching_kernels import U64, nearest_descriptors


@register("loop", "appearance")
@dataclass(frozen=True)
class AppearanceLoop(WordOptions):
    """Recognise a place by a bag of binary words, trained on the keyframes that are compared: nothing is downloaded.

    A keyframe is a candidate when its similarity is a share of that of the newest keyframe and its predecessor (DBoW2: Gálvez-López and Tardós, T-RO
    2012): the L1 distance of normalised tf-idf vectors. Every candidate is verified with points, lines and planes and by free space; the correction
    is that of a pose graph. A scene without points has no words."""

    def __call__(self, map: Map, frame: Frame) -> Correction | None:
        """Return the correction; None unless the newest keyframe closes a loop, or the map has rotated out of its Manhattan frame."""
        return close_loop(self, partial(rank_by_words, self, self._words), map, frame)

    def _words(self, map: Map, points: I32) -> tuple[I32, int]:
        """The word (n,) of each point, and the length of the vocabulary."""
        if not len(points):
            return np.zeros(0, np.int32), 0
        bits = as_bits(map.points.rows("descriptor", points))
        chosen = np.linspace(0, len(bits) - 1, min(self.training, len(bits))).round().astype(int)
        vocabulary = train(bits[chosen], self.words, self.rounds)
        return nearest_words(bits, vocabulary), len(vocabulary)


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
