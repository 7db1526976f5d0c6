"""Loops found by what the points look like."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import I32, Map
from trihedron.plugins.numerics.maps.local_window import observed_by
from trihedron.plugins.numerics.places.binary_words import as_bits, nearest_words, similarities, train
from trihedron.plugins.numerics.places.loop_closing import LoopClosing
from trihedron.plugins.numerics.places.loop_places import walked, within_reach


@register("loop", "appearance")
@dataclass(frozen=True)
class AppearanceLoop(LoopClosing):
    """Recognise a place by a bag of binary words, trained on the keyframes that are compared: nothing is downloaded.

    A keyframe is a candidate when it is as alike as a share of what the newest keyframe and its predecessor have in common (DBoW2). Every candidate
    is verified with points, lines and planes and by free space; the correction is that of a pose graph. A scene without points has no words."""

    words: int = 256
    rounds: int = 2  # of the training
    training: int = 4000  # most descriptors it uses
    context: int = 30  # other keyframes, spread over the run, that say which words are common
    looked_at: int = 20  # keyframes within reach that are compared, the nearest first
    min_likeness: float = 0.3  # share of the predecessor's likeness

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("words", "rounds", "training", "context", "looked_at"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1")
        if not 0.0 <= self.min_likeness <= 1.0:
            raise ValueError("min_likeness: must be in [0, 1]")

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
