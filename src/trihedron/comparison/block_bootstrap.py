"""A weighted sum of means, plain or root mean squares, over the frames of one recording, with its standard error by the moving-block bootstrap
(Künsch, 1989).

The errors of neighbouring frames are alike, so that frames are no independent samples; blocks of consecutive frames nearly are, when they are longer
than the errors remember. Blocks are drawn with replacement, the same for all series, until the recording has its length again; the spread of the sum
over such resamples is its standard error. The difference of two alternatives has the weights -1 and 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64, Bool

RESAMPLES = 2000
SEED = 0  # of the blocks drawn: the same errors give the same interval
FEWEST_BLOCKS = 8  # a spread over fewer means nothing
BIAS = 0.1  # largest share by which blocks make the variance too small, before it is corrected


@dataclass(frozen=True)
class Resampled:
    """Weighted sum of means, its standard error (None: fewer than `FEWEST_BLOCKS`), the number of blocks and the frames of one."""

    value: float
    error: float | None
    blocks: int
    length: int


def power_mean(values: F64, power: int) -> float:
    """Return the mean of values that are not negative, (n,): plain for the power 1, their root mean square for 2."""
    return float(np.mean(values**power) ** (1.0 / power))


def bootstrap_blocks(errors: Sequence[F64], weights: Sequence[float], shortest: int, power: int = 2) -> Resampled:
    """Sum the power means (as `power_mean`) of k series of errors (n,), none negative, of the same frames, each with its weight.

    Frames where one is not finite are left out; at least one must remain. A block has at least `shortest` frames. The standard error of b blocks is
    the spread of the resamples times sqrt(b / (b - 1)), as that of a mean of b values, and corrected for the bias of `block_length`; b - 1 are its
    degrees of freedom."""
    series, factors = np.array(errors), np.array(weights)[:, None]
    found = np.flatnonzero(np.isfinite(series).all(axis=0))
    series = series[:, found[0] : found[-1] + 1]
    known: Bool = np.asarray(np.isfinite(series).all(axis=0))
    powers = np.where(known, series**power, 0.0)
    means = ((powers.sum(axis=1) / known.sum()) ** (1.0 / power))[:, None]
    derivatives = np.where(means > 0.0, power * means ** (power - 1), 1.0)
    parts = (factors * powers / derivatives).sum(axis=0)  # each frame's part in the sum, to first order
    length, bias = block_length(np.where(known, parts, np.nan), shortest)
    length = min(length, len(known))
    value, blocks = float((factors * means).sum()), len(known) // length
    if blocks < FEWEST_BLOCKS:
        return Resampled(value, None, blocks, length)
    sums = np.concatenate([np.zeros((len(series) + 1, 1)), np.cumsum([*powers, known], axis=1)], axis=1)
    of_blocks = sums[:, length:] - sums[:, :-length]
    drawn = np.random.default_rng(SEED).integers(0, of_blocks.shape[1], (RESAMPLES, blocks))
    *totals, counts = of_blocks[:, drawn].sum(axis=2)
    drawn_means = (np.maximum(totals, 0.0)[:, counts > 0] / counts[counts > 0]) ** (1.0 / power)
    spread = float(np.std((factors * drawn_means).sum(axis=0)))
    return Resampled(value, float(spread * np.sqrt(blocks / (blocks - 1) / (1.0 - bias))), blocks, length)


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
