"""Loop candidates by a bag of words: tf-idf vectors of the words that keyframes show (Sivic and Zisserman, ICCV 2003)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import PositiveInt, Share
from trihedron.pipeline.core.types import F64, I32, Map
from trihedron.plugins.loop.loop_closing import LoopOptions, path_lengths, within_reach
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.mapping.landmark_kinds import POINT

HISTOGRAM = 128  # least bytes of a histogram (SIFT) or learned descriptor: its bits are those above the median
Words = Callable[[Map, I32], tuple[I32, int]]  # word (n,) of each of some points, and the length of the vocabulary; 0: too few points


@dataclass(frozen=True)
class WordOptions(LoopOptions):
    """Options of a bag of words."""

    words: PositiveInt = 256
    rounds: PositiveInt = 2  # of the training
    training: PositiveInt = 4000  # most descriptors it uses
    context: PositiveInt = 30  # other keyframes, spread over the run, that say which words are common
    looked_at: PositiveInt = 20  # keyframes within reach that are compared, the nearest first
    min_likeness: Share = 0.3  # share of the predecessor's likeness


def rank_by_words(options: WordOptions, words_of: Words, map: Map) -> Iterator[tuple[int, float]]:
    """Yield keyframes within reach, the most similar first, with the length of the path since."""
    rows, path_m = within_reach(options, map, options.looked_at)
    living, _ = path_lengths(map)
    if not len(rows) or len(living) < 2:
        return
    spread = living[np.linspace(0, len(living) - 1, min(options.context, len(living))).round().astype(int)]
    ids = [observed_by(map, np.array([row], np.int32), POINT) for row in (*spread, living[-2], *rows, living[-1])]
    known = np.unique(np.concatenate(ids)).astype(np.int32)
    words, count = words_of(map, known)
    if not count:
        return
    similarity = similarities([words[np.searchsorted(known, one)] for one in ids], count)[len(spread) :]
    for k in np.argsort(-similarity[1:], kind="stable"):
        if similarity[1 + k] >= options.min_likeness * similarity[0] and similarity[1 + k] > 0.0:
            yield int(rows[k]), float(path_m[k])


def similarities(bags: list[I32], words: int) -> F64:
    """Return the similarity (m - 1,) of the last of m bags of words to each other one: 1 for the same words, 0 for none in common."""
    counts = np.array([np.bincount(bag, minlength=words) for bag in bags], np.float64).reshape(len(bags), words)
    idf = np.log(len(bags) / np.maximum(np.count_nonzero(counts, axis=0), 1))
    weighed = counts * np.maximum(idf, 1e-6)
    weighed /= np.maximum(weighed.sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(1.0 - 0.5 * np.abs(weighed[:-1] - weighed[-1]).sum(axis=1))
