"""The difference of two root mean squares over the frames of one recording, and its standard error by the moving-block bootstrap (Künsch, 1989).

The errors of neighbouring frames are alike, so that frames are no independent samples; blocks of consecutive frames nearly are, when they are longer
than the errors remember. Blocks are drawn with replacement, the same for both series, until the recording has its length again; the difference is
computed from the frames drawn; its spread over the resamples is its standard error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64

RESAMPLES = 2000
SEED = 0  # of the blocks drawn: the same errors give the same interval
FEWEST_BLOCKS = 8  # a spread over fewer means nothing
BIAS = 0.1  # largest share by which blocks make the variance too small, before it is corrected


@dataclass(frozen=True)
class Resampled:
    """Difference of two root mean squares, its standard error (None: fewer than `FEWEST_BLOCKS`), the number of blocks and the frames of one."""

    difference: float
    error: float | None
    blocks: int
    length: int


def resampled(first: F64, second: F64, shortest: int) -> Resampled:
    """Compare two series of errors (n,) of the same frames: root mean square of the second minus that of the first.

    Frames where either is not finite are left out; at least one must remain. A block has at least `shortest` frames. The standard error of b blocks
    is the spread of the resamples times sqrt(b / (b - 1)), as that of a mean of b values, and corrected for the bias of `block_length`; b - 1 are its
    degrees of freedom."""
    both = np.isfinite(first) & np.isfinite(second)
    found = np.flatnonzero(both)
    part = slice(found[0], found[-1] + 1)
    both = both[part]
    squares = np.where(both, np.square([first[part], second[part]]), 0.0)
    roots = np.sqrt(squares.sum(axis=1) / both.sum())
    difference = float(roots[1] - roots[0])
    slopes = squares / np.where(roots > 0.0, 2.0 * roots, 1.0)[:, None]  # each frame's part in the root mean square, to first order
    length, bias = block_length(np.where(both, slopes[1] - slopes[0], np.nan), shortest)
    length = min(length, len(both))
    blocks = len(both) // length
    if blocks < FEWEST_BLOCKS:
        return Resampled(difference, None, blocks, length)
    sums = np.concatenate([np.zeros((3, 1)), np.cumsum([*squares, both], axis=1)], axis=1)
    of_blocks = sums[:, length:] - sums[:, :-length]
    drawn = np.random.default_rng(SEED).integers(0, of_blocks.shape[1], (RESAMPLES, blocks))
    squares_a, squares_b, counts = of_blocks[:, drawn].sum(axis=2)
    known = counts > 0
    differences = np.sqrt(np.maximum(squares_b[known], 0.0) / counts[known]) - np.sqrt(np.maximum(squares_a[known], 0.0) / counts[known])
    return Resampled(difference, float(np.std(differences) * np.sqrt(blocks / (blocks - 1) / (1.0 - bias))), blocks, length)


def block_length(series: F64, shortest: int) -> tuple[int, float]:
    """Return the length of blocks of a series (n,) whose mean is resampled, at least `shortest`, and the share by which its variance comes out small.

    NaN is left out. The share is S / length, with S = sum |k| R(k) / sum R(k) over the autocovariances R(k) (Künsch, 1989); the length is such that
    it is at most `BIAS`. The lags k go to twice that beyond which R is not significant, under the flat-top window of Politis and White (2004). A
    series that is still correlated over the longest blocks of which there are `FEWEST_BLOCKS` is too short: the length is n."""
    n, centred = len(series), np.nan_to_num(series - np.nanmean(series))
    most, run = n // FEWEST_BLOCKS, max(5, int(np.ceil(np.log10(n))))
    covariances = np.array([centred[lag:] @ centred[: n - lag] for lag in range(most + 1)]) / n
    if covariances[0] <= 0.0:
        return shortest, 0.0
    small = np.abs(covariances[1:] / covariances[0]) < 2.0 * np.sqrt(np.log10(n) / n)
    last = next((lag for lag in range(len(small) - run + 1) if small[lag : lag + run].all()), None)  # the last significant lag
    if last is None:
        return max(shortest, n), 0.0
    lags = np.arange(1, min(2 * max(last, 1), most) + 1)
    window = np.minimum(1.0, 2.0 * (1.0 - lags / len(lags))) * covariances[lags]
    spectrum, slope = covariances[0] + 2.0 * window.sum(), 2.0 * (lags * window).sum()
    memory = max(0.0, slope / spectrum) if spectrum > 0.0 else 0.0
    length = max(shortest, int(np.ceil(memory / BIAS)))
    return length, memory / length
