"""Bags of binary words: a vocabulary trained on the run's own descriptors, and how alike two images are by the words in them.

Words are the centres of a k-majority clustering (Grana et al. 2013: k-means for bits); images are compared as in DBoW2 (Gálvez-López and Tardós,
T-RO 2012), by the L1 distance of their normalised tf-idf vectors."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import F64, I32, U8
from trihedron.plugins.numerics.images.descriptors import hamming, words_of

U64 = NDArray[np.uint64]
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def nearest_words(bits: U64, vocabulary: U64) -> I32:
    """(n,) row of the nearest word of each descriptor, the first of equally near ones."""
    out = np.zeros(len(bits), np.int32)
    for i in range(len(bits)):
        best = 1 << 30
        for k in range(len(vocabulary)):
            distance = hamming(bits[i], vocabulary[k])
            if distance < best:
                best = distance
                out[i] = k
    return out


def similarities(bags: list[I32], words: int) -> F64:
    """(m - 1,) how alike the last of m bags of words is to each other one: 1 for the same words, 0 for none in common."""
    counts = np.array([np.bincount(bag, minlength=words) for bag in bags], np.float64).reshape(len(bags), words)
    idf = np.log(len(bags) / np.maximum(np.count_nonzero(counts, axis=0), 1))
    weighed = counts * np.maximum(idf, 1e-6)
    weighed /= np.maximum(weighed.sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(1.0 - 0.5 * np.abs(weighed[:-1] - weighed[-1]).sum(axis=1))
