"""Verdicts in words: which of two alternatives is better in a figure, by how much, and how sure that is.

Figures that are means over frames, plain or root mean squares, are compared on the frames of which both alternatives have a value. Of one recording
their difference has an interval by the moving-block bootstrap. Of several recordings each is one difference, and the interval of their mean is
Student's t: what varies between stretches of a recording varies between recordings too, and drawing blocks within them besides would count it twice
(such intervals, of five simulated recordings, cover in 99 to 100 % instead of 95).

P-values are corrected by Holm over all pairs of alternatives that are compared in the same figure: in a figure in which nothing differs, the chance
of any "better" or "worse" is 5 %. Figures are not corrected for one another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from trihedron.comparison.block_bootstrap import bootstrap_blocks, power_mean
from trihedron.pipeline.core.types import F64
from trihedron.pipeline.sweep.paired_statistics import LEVEL, MOST_REPEATS, POWER, half_width, holm, p_value, power, repeats_needed

SMALL_SHARE = 0.05  # of the first alternative's figure: the difference that further recordings would show
ROUNDING = 1e-12  # of a figure: less is no difference, and no spread
TOO_SHORT = "too short to tell"
NO_INTERVAL = "one recording, no interval"
EQUAL = "equal"
VERDICTS = "Verdicts"  # the title of the lines, and the note below them
NOTE = (
    "the second against the first; 95 % interval from the frames of one recording (moving-block bootstrap), or over several (Student's t);\n"
    "answers by Holm over all pairs of a figure; d: the difference by its standard deviation from segment to segment, or recording to recording"
)


@dataclass(frozen=True)
class Column:
    """A figure's decimals, whether more of it is better, and the power of the mean over frames that it is: 2 a root mean square, 1 a plain mean, 0
    no mean over frames."""

    decimals: int
    more: bool = False
    power: int = 2


@dataclass(frozen=True)
class Sample:
    """Outcome of an alternative on one recording: figures by column, and of those that are means over frames the value (n,) of each, NaN where it
    has none, in the figure's unit. `second` is the number of frames in one second, which a block has at least."""

    figures: Mapping[str, float]
    errors: Mapping[str, F64] = field(default_factory=dict)
    second: int = 30


Pairs = Sequence[tuple[Sample, Sample]]  # of two alternatives, one a recording


@dataclass(frozen=True)
class Verdict:
    """The second alternative against the first in one figure.

    `before`, `after`: the figure of the first and the second, means over the recordings. `pieces`: the number of segments of the one recording
    (blocks), or of recordings. `error`: standard error of the difference, with `pieces - 1` degrees of freedom. `low`, `high`: ends of the 95 %
    interval. `corrected`: p-value after Holm's correction. `effect`: the difference by its standard deviation from piece to piece. `needed`: how many
    recordings of this length more would show a difference of 5 % of `before` in 8 of 10 studies. `answer`: the verdict in words. What is not
    known is None."""

    first: str
    second: str
    figure: str
    before: float
    after: float
    difference: float
    pieces: int
    recordings: int
    block_frames: int | None = None
    error: float | None = None
    low: float | None = None
    high: float | None = None
    p: float | None = None
    corrected: float | None = None
    effect: float | None = None
    needed: int | None = None
    answer: str = ""


def verdicts_of(comparisons: Mapping[tuple[str, str], Pairs], columns: Mapping[str, Column]) -> list[Verdict]:
    """Return the verdicts of each pair of alternatives (first, second) in each column that both have, in this order. Of one recording there are none
    in a figure that is not of frames. Pairs that are equal by construction do not count for the correction."""
    differences = [_difference(names, name, column.power, pairs) for names, pairs in comparisons.items() for name, column in columns.items()]
    found = [one for one in differences if one is not None and (one.recordings > 1 or columns[one.figure].power)]
    corrected: dict[int, tuple[float, int]] = {}
    for column in columns:
        unequal = {number: one for number, one in enumerate(found) if one.figure == column and (one.error or one.difference)}
        tested = [(number, one.p) for number, one in unequal.items() if one.p is not None]
        corrected |= {number: (p, len(tested)) for (number, _), p in zip(tested, holm([p for _, p in tested]))}
    return [_with_answer(one, columns[one.figure], *corrected.get(number, (one.p, 1))) for number, one in enumerate(found)]


def _difference(names: tuple[str, str], column: str, power: int, pairs: Pairs) -> Verdict | None:
    """Return the difference of a pair of alternatives with its interval, before the correction; None where no recording has both figures."""
    values = np.array([_paired_figures(column, power, a, b) for a, b in pairs]).reshape(-1, 2)
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    if not len(known):
        return None
    before, after = values[known].mean(axis=0)
    one = Verdict(*names, column, float(before), float(after), float(after - before), len(known), len(known))
    a, b = pairs[known[0]]
    if len(known) > 1:
        error: float | None = float(np.std(np.diff(values[known], axis=1), ddof=1) / np.sqrt(len(known)))
    elif power and column in a.errors and column in b.errors:
        found = bootstrap_blocks([a.errors[column], b.errors[column]], [-1.0, 1.0], max(1, a.second), power)
        one, error = replace(one, pieces=found.blocks, block_frames=found.length), found.error
        if np.array_equal(a.errors[column], b.errors[column], equal_nan=True):
            error = 0.0
    else:
        return one
    return one if error is None else _with_interval(one, error)


def _paired_figures(column: str, power: int, a: Sample, b: Sample) -> tuple[float, float]:
    """Return the figure of both, over the frames of which both have a value; as they are where it is no mean over frames."""
    if not power or column not in a.errors or column not in b.errors:
        return a.figures.get(column, np.nan), b.figures.get(column, np.nan)
    both = np.isfinite(a.errors[column]) & np.isfinite(b.errors[column])
    if not both.any():
        return np.nan, np.nan
    before, after = (power_mean(one.errors[column][both], power) for one in (a, b))
    return before, after


def _with_interval(one: Verdict, error: float) -> Verdict:
    scale = ROUNDING * max(abs(one.before), abs(one.after))
    difference, error = (0.0 if abs(value) <= scale else value for value in (one.difference, error))
    half, deviation = half_width(error, one.pieces - 1) if error else 0.0, error * np.sqrt(one.pieces)
    return replace(
        one,
        difference=difference,
        error=error,
        low=difference - half,
        high=difference + half,
        p=p_value(difference, error, one.pieces - 1),
        effect=float(difference / deviation) if error else None,
    )


def _with_answer(one: Verdict, column: Column, corrected: float | None, tests: int) -> Verdict:
    """Add the words; `tests` is the number of comparisons that the correction is for."""
    if corrected is None or one.error is None:
        return replace(one, answer=NO_INTERVAL if one.block_frames is None else TOO_SHORT)
    if not any(float(_signed_text(value, column)) for value in (one.low, one.high) if value is not None):  # zero to the digits shown
        return replace(one, corrected=corrected, answer=EQUAL)
    if corrected < LEVEL:
        return replace(one, corrected=corrected, answer="better" if (one.difference > 0.0) == column.more else "worse")
    needed = recordings_needed(one, LEVEL / tests)
    if needed is None:
        wanting = f"more than {MOST_REPEATS} seeds would be needed to show 5 %"
    else:
        wanting = f"{needed} seed{'s' if needed > 1 else ''} more would show 5 %" if needed else "5 % would have been shown"
    return replace(one, corrected=corrected, needed=needed, answer=f"no difference shown; {wanting}")


def recordings_needed(one: Verdict, level: float) -> int | None:
    """Return how many further recordings of the same length would show a difference of 5 % of `before` with a power of 80 % at this level, by a
    paired t test over recordings; 0 where this comparison would have shown it, None above 10 000.

    A difference of one recording alone is taken to vary from one to the next as it does within: scenes that are less alike need more."""
    if not one.error:
        return None
    wanted = SMALL_SHARE * abs(one.before)
    if power(wanted / one.error, one.pieces - 1, level) >= POWER:
        return 0
    total = repeats_needed(wanted / (one.error * np.sqrt(one.recordings)), level)
    return None if total is None else max(1, total - one.recordings)


def line_of(one: Verdict, column: Column) -> str:
    """Return a verdict as one line: `A against B: ATE 12.31 -> 13.08 mm, +0.77 (95 %: +0.21 to +1.40), d 0.90: worse`."""
    name, _, unit = one.figure.rpartition(" ")
    figure = f"{name or 'time'} {one.before:.{column.decimals}f} -> {one.after:.{column.decimals}f} {unit}"
    text = f"{comparison_name(one.first, one.second)}: {figure}, {_signed_text(one.difference, column)}"
    if one.low is not None and one.high is not None:
        text += f" (95 %: {_signed_text(one.low, column)} to {_signed_text(one.high, column)})"
    elif one.block_frames is not None:
        text += f" ({one.pieces} block{'' if one.pieces == 1 else 's'} of {one.block_frames} frames)"
    if one.effect is not None:
        text += f", d {one.effect:.1f}"
    return f"{text}: {one.answer}"


def comparison_name(first: str, second: str) -> str:
    """Return "first against second"; a key that both single words have is written once."""
    key, value = first.partition("=")[0], second.partition("=")[2]
    short = " " not in first + second and value and second.startswith(f"{key}=")
    return f"{first} against {value if short else second}"


def _signed_text(value: float, column: Column) -> str:
    text = f"{value:+.{column.decimals}f}"
    return text if float(text) else text.lstrip("+-")
