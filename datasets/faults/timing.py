"""Delivery of frames, their order and times: dropped, repeated and reversed frames, and clocks that jump."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.options import frame_range

Numbers = NDArray[np.int64]
STREAM = 4  # of the random numbers that choose the dropped frames


@dataclass(frozen=True)
class Delivery:
    """Delivery of the frames of a sequence: dropped, reversed, late. Ranges are of the sequence's own frame numbers."""

    drop: str = ""
    drop_share: float = 0.0
    every: int = 1
    freeze: str = ""
    reverse: str = ""
    jump: int = 0
    jump_s: float = 0.0

    def frame_numbers(self, count: int, seed: int) -> Numbers:
        """(n,) numbers of the frames of a sequence of `count` that arrive, in the order in which they do. The first frame always does."""
        numbers = np.arange(count)
        lost = inside(self.drop, numbers) | (np.random.default_rng([seed, STREAM]).random(count) < self.drop_share)
        kept = numbers[~lost | (numbers == 0)][:: self.every]
        turned = inside(self.reverse, kept)
        kept[turned] = kept[turned][::-1]
        return np.asarray(kept)

    def source_frame(self, number: int) -> int:
        """The frame whose images arrive as those of frame `number`: another one while the camera is frozen."""
        return frame_range(self.freeze).start if bool(inside(self.freeze, np.array([number]))[0]) else number

    def stamp_ns(self, stamp_ns: int, number: int) -> int:
        """Return the reading of the faulty clock at `stamp_ns`."""
        return stamp_ns + (round(self.jump_s * 1e9) if number >= self.jump else 0)


def inside(frames: str, numbers: Numbers) -> NDArray[np.bool_]:
    """(n,) whether frame numbers lie in the range A:B or A:B:S; none does where it is empty."""
    if not frames:
        return np.zeros(len(numbers), bool)
    chosen = frame_range(frames)
    return np.asarray((numbers >= chosen.start) & (numbers < chosen.stop) & ((numbers - chosen.start) % chosen.step == 0))
