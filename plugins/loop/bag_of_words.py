"""Loops found by a bag of words of SciPy's k-means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, F64, I32, U8, Map
from trihedron.plugins.loop.appearance import HISTOGRAM, AppearanceLoop, similarities


@register("loop", "bag_of_words")
@dataclass(frozen=True)
class BagOfWords(AppearanceLoop):
    """Words are the clusters of `scipy.cluster.vq.kmeans2` (Sivic and Zisserman, ICCV 2003), trained on the keyframes that are compared and weighted
    by their inverse document frequency; places are then verified as those of `appearance`.

    The retrieval of pycolmap 4.2 cannot be used: its Python binding returns no scores. Library: SciPy (BSD). Sums of single precision: the bytes may
    differ on another CPU."""

    def _similarities(self, map: Map, ids: list[I32]) -> F64:
        """Similarity of the last of some sets of points to each of the others."""
        from scipy.cluster.vq import kmeans2, vq

        known = np.unique(np.concatenate(ids)).astype(np.int32)
        if len(known) < 2:
            return np.zeros(len(ids) - 1)
        vectors = as_vectors(map.points.rows("descriptor", known))
        chosen = vectors[np.linspace(0, len(vectors) - 1, min(self.training, len(vectors))).round().astype(int)]
        start = chosen[np.unique(np.linspace(0, len(chosen) - 1, min(self.words, len(chosen))).round().astype(int))]
        vocabulary, _ = kmeans2(chosen, start, iter=self.rounds, minit="matrix", missing="warn")
        words, _ = vq(vectors, vocabulary)
        return similarities([words[np.searchsorted(known, one)].astype(np.int32) for one in ids], len(vocabulary))


def as_vectors(descriptors: U8) -> F32:
    """(n, b) histograms, or bits of (n, b / 8) bytes, as vectors."""
    histograms = descriptors.shape[1] >= HISTOGRAM
    return (descriptors if histograms else np.unpackbits(descriptors, axis=1)).astype(np.float32)
