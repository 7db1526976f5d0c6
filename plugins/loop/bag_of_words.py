"""Loops found by a bag of words of SciPy's k-means."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, I32, U8, Correction, Frame, Map
from trihedron.plugins.loop.loop_closing import close_loop
from trihedron.plugins.loop.tf_idf_ranking import HISTOGRAM, WordOptions, rank_by_words


@register("loop", "bag_of_words")
@dataclass(frozen=True)
class BagOfWords(WordOptions):
    """Words are the clusters of `scipy.cluster.vq.kmeans2` (Sivic and Zisserman, ICCV 2003), trained on the keyframes that are compared and weighted
    by their inverse document frequency; places are then verified as those of `appearance`.

    The retrieval of pycolmap 4.2 cannot be used: its Python binding returns no scores. Library: SciPy (BSD). Sums of single precision: the bytes may
    differ on another CPU."""

    def __call__(self, map: Map, frame: Frame) -> Correction | None:
        """Return the correction; None unless the newest keyframe closes a loop, or the map has rotated out of its Manhattan frame."""
        return close_loop(self, partial(rank_by_words, self, self._words), map, frame)

    def _words(self, map: Map, points: I32) -> tuple[I32, int]:
        """The word (n,) of each point, and the length of the vocabulary."""
        from scipy.cluster.vq import kmeans2, vq

        if len(points) < 2:
            return np.zeros(len(points), np.int32), 0
        vectors = as_vectors(map.points.rows("descriptor", points))
        chosen = vectors[np.linspace(0, len(vectors) - 1, min(self.training, len(vectors))).round().astype(int)]
        start = chosen[np.unique(np.linspace(0, len(chosen) - 1, min(self.words, len(chosen))).round().astype(int))]
        vocabulary, _ = kmeans2(chosen, start, iter=self.rounds, minit="matrix", missing="warn")
        words, _ = vq(vectors, vocabulary)
        return words.astype(np.int32), len(vocabulary)


def as_vectors(descriptors: U8) -> F32:
    """(n, b) histograms, or bits of (n, b / 8) bytes, as vectors."""
    histograms = descriptors.shape[1] >= HISTOGRAM
    return (descriptors if histograms else np.unpackbits(descriptors, axis=1)).astype(np.float32)
