"""Verdicts on known truth: coverage and false alarms of the intervals, the words, and the number of seeds."""

import re

import numpy as np
import pytest
from scipy.stats import norm, t

from trihedron.comparison.block_bootstrap import block_length, bootstrap_blocks
from trihedron.comparison.verdicts import Column, Sample, Verdict, comparison_name, line_of, recordings_needed, verdicts_of

ATE = {"ATE mm": Column(2)}
DIFFERENCE = [-1.0, 1.0]


def autoregressive(rng, count, frames, memory):
    """Stationary AR(1) series (count, frames) of variance 1."""
    noise = rng.normal(0.0, np.sqrt(1.0 - memory**2), (count, frames + 100))
    noise[:, 0] /= np.sqrt(1.0 - memory**2)
    for frame in range(1, frames + 100):
        noise[:, frame] += memory * noise[:, frame - 1]
    return noise[:, 100:]


def errors(rng, frames, memory, *scales):
    """Errors (frames,) of some alternatives: lengths of vectors whose components are AR(1), half of their variance common; with root mean
    squares `scales`."""
    common, *own = autoregressive(rng, 3 * (1 + len(scales)), frames, memory).reshape(-1, 3, frames)
    return [scale * np.sqrt(np.mean((common + one) ** 2 / 2.0, axis=0)) for scale, one in zip(scales, own)]


def sample(values, **figures):
    return Sample(figures, {} if values is None else {"ATE mm": values}, 30)


@pytest.mark.parametrize(("memory", "frames"), [(0.0, 300), (0.8, 600), (0.9, 1200)])
def test_the_interval_covers_the_true_difference(memory, frames):
    rng, covered = np.random.default_rng(2), []
    for _ in range(200):
        found = bootstrap_blocks(errors(rng, frames, memory, 1.0, 1.2), DIFFERENCE, 30)
        if found.error is not None:
            covered.append(abs(found.value - 0.2) <= t.ppf(0.975, found.blocks - 1) * found.error)
    assert len(covered) > 190 and 0.90 <= np.mean(covered) <= 0.98


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_the_interval_of_a_share_covers_the_true_difference(memory):
    """Frames are `ok` or not, 80 and 70 % of them: the figure is a plain mean."""
    rng, covered = np.random.default_rng(3), []
    for _ in range(200):
        a, b = (100.0 * (series < z) for series, z in zip(autoregressive(rng, 2, 900, memory), norm.ppf([0.8, 0.7])))
        found = bootstrap_blocks([a, b], DIFFERENCE, 30, 1)
        assert found.value == pytest.approx(np.mean(b) - np.mean(a), abs=1e-9)
        if found.error is not None:
            covered.append(abs(found.value + 10.0) <= t.ppf(0.975, found.blocks - 1) * found.error)
    assert len(covered) > 180 and 0.90 <= np.mean(covered) <= 0.99


@pytest.mark.parametrize("memory", [0.95, 0.99])
def test_a_recording_too_short_for_its_memory_gives_few_false_verdicts(memory):
    """Where errors are alike over much of a recording, most have no answer; those that have one are wrong in less than 5 % of all recordings."""
    rng, answers = np.random.default_rng(0), []
    for _ in range(200):
        a, b = errors(rng, 300, memory, 1.0, 1.0)
        (found,) = verdicts_of({("a", "b"): [(sample(a), sample(b))]}, ATE)
        answers.append(found.answer)
    assert answers.count("too short to tell") > 100
    assert answers.count("better") + answers.count("worse") <= 10


def test_no_difference_gives_few_false_verdicts_over_many_comparisons():
    """Six pairs of four alternatives that do not differ: at most 5 % of the ablations give any verdict."""
    rng, false = np.random.default_rng(0), 0
    for _ in range(120):
        a, b, c, d = (sample(values) for values in errors(rng, 300, 0.5, 1.0, 1.0, 1.0, 1.0))
        pairs = {("a", "b"): [(a, b)], ("a", "c"): [(a, c)], ("a", "d"): [(a, d)], ("b", "c"): [(b, c)], ("b", "d"): [(b, d)], ("c", "d"): [(c, d)]}
        found = verdicts_of(pairs, ATE)
        assert all(one.corrected >= one.p for one in found)
        false += any(one.answer in ("better", "worse") for one in found)
    assert false <= 6


def test_a_difference_of_20_percent_in_300_frames_is_found():
    rng, found = np.random.default_rng(1), 0
    for _ in range(50):
        a, b = errors(rng, 300, 0.5, 1.0, 1.2)
        (there,), (back,) = (verdicts_of({("a", "b"): [pair]}, ATE) for pair in ((sample(a), sample(b)), (sample(b), sample(a))))
        found += (there.answer, back.answer) == ("worse", "better")
        assert there.pieces == 10 and there.difference == pytest.approx(-back.difference)
    assert found >= 48


def test_the_same_errors_give_the_same_verdict():
    a, b = errors(np.random.default_rng(3), 400, 0.5, 1.0, 1.1)
    pairs = {("a", "b"): [(sample(a), sample(b))]}
    assert verdicts_of(pairs, ATE) == verdicts_of(pairs, ATE)


def test_only_frames_that_both_have_are_compared():
    rng = np.random.default_rng(4)
    a, b = errors(rng, 600, 0.5, 1.0, 1.0)
    b[:100], a[:100] = np.nan, 50.0
    a[250:260] = np.nan
    (found,) = verdicts_of({("a", "b"): [(sample(a), sample(b))]}, ATE)
    both = np.isfinite(a) & np.isfinite(b)
    assert (found.before, found.after) == pytest.approx([np.sqrt(np.mean(one[both] ** 2)) for one in (a, b)])
    assert found.difference == pytest.approx(found.after - found.before) and found.pieces == 16
    assert verdicts_of({("a", "b"): [(sample(np.full(9, np.nan)), sample(np.ones(9)))]}, ATE) == []


def test_blocks_are_as_long_as_the_memory_asks_for():
    """Of an AR(1) series S = 2 r / (1 - r²), and blocks have ten times that."""
    rng = np.random.default_rng(0)
    assert block_length(rng.normal(size=3000), 30)[0] == 30 and block_length(np.zeros(100), 30) == (30, 0.0)
    lengths = [block_length(series, 1)[0] for series in autoregressive(rng, 40, 5000, 0.9)]
    assert np.median(lengths) == pytest.approx(10 * 2 * 0.9 / (1 - 0.81), rel=0.15)
    assert block_length(np.arange(300.0), 30) == (300, 0.0)


def paired(rng, count, difference, spread):
    """Recordings whose figures alone are known, a difference from the first (10) that is normal."""
    after = 10.0 + difference + spread * rng.normal(size=count)
    return [(Sample({"ATE mm": 10.0}), Sample({"ATE mm": float(value)})) for value in after]


@pytest.mark.parametrize(("kind", "tests"), [("one recording", 1), ("one recording", 6), ("several", 1)])
def test_the_number_of_seeds_shows_5_percent_in_8_of_10_simulated_studies(kind, tests):
    """By a t test over them all, at the level that Holm's correction leaves to the smallest of several p-values; one seed less does not."""
    rng, level = np.random.default_rng(0), 0.05 / tests
    if kind == "several":
        found = Verdict("a", "b", "ATE mm", 10.0, 10.1, 0.1, 6, 6, error=0.4 / np.sqrt(6))
        deviation, have = 0.4, 6
    else:
        found = Verdict("a", "b", "ATE mm", 10.0, 10.1, 0.1, 20, 1, block_frames=30, error=0.4)
        deviation, have = 0.4, 1
    more = recordings_needed(found, level)
    assert more > 0
    shown = []
    for count in (have + more, have + more - 1):
        differences = 0.5 + deviation * rng.normal(size=(20_000, count))
        statistic = differences.mean(axis=1) / differences.std(axis=1, ddof=1) * np.sqrt(count)
        shown.append(np.mean(np.abs(statistic) > t.ppf(1.0 - level / 2.0, count - 1)))
    assert shown[0] > 0.79 and shown[1] < 0.81


def test_seeds_are_seeds_of_the_recording_that_was_resampled():
    """The spread that one recording's blocks foretell is that of the differences of further recordings."""
    rng = np.random.default_rng(6)
    foretold = np.median([bootstrap_blocks(errors(rng, 600, 0.8, 10.0, 10.0), DIFFERENCE, 30).error for _ in range(60)])
    differences = [bootstrap_blocks(errors(rng, 600, 0.8, 10.0, 10.0), DIFFERENCE, 600).value for _ in range(200)]
    assert foretold == pytest.approx(np.std(differences), rel=0.15)


def test_the_words():
    def words(differences, column="ATE mm", more=False, first="manhattan=plane_svd", second="manhattan=mean_shift"):
        pairs = [(Sample({column: 10.0}), Sample({column: 10.0 + value})) for value in differences]
        columns = {column: Column(2, more)}
        (found,) = verdicts_of({(first, second): pairs}, columns)
        return line_of(found, columns[column])

    assert words([0.7, 0.8, 0.9]) == "manhattan=plane_svd against mean_shift: ATE 10.00 -> 10.80 mm, +0.80 (95 %: +0.55 to +1.05), d 8.0: worse"
    assert words([-0.7, -0.8, -0.9]) == "manhattan=plane_svd against mean_shift: ATE 10.00 -> 9.20 mm, -0.80 (95 %: -1.05 to -0.55), d -8.0: better"
    assert words([0.7, 0.8, 0.9], "ok %", True, "as recorded", "bundle=none").endswith(
        ": ok 10.00 -> 10.80 %, +0.80 (95 %: +0.55 to +1.05), d 8.0: better"
    )
    text = words([1.0, -1.0, 0.5, -0.4])
    assert text.endswith("ATE 10.00 -> 10.03 mm, +0.03 (95 %: -1.40 to +1.45), d 0.0: no difference shown; 24 seeds more would show 5 %")
    assert words([0.5, -0.45, 0.0], "ms").endswith(
        ": time 10.00 -> 10.02 ms, +0.02 (95 %: -1.16 to +1.20), d 0.0: no difference shown; 7 seeds more would show 5 %"
    )
    assert words([0.03, -0.05, 0.05]).endswith(": no difference shown; 5 % would have been shown")
    assert words([90.0, -90.0, 0.5]).endswith(": no difference shown; more than 10000 seeds would be needed to show 5 %")
    assert words([0.0, 0.0]).endswith("ATE 10.00 -> 10.00 mm, 0.00 (95 %: 0.00 to 0.00): equal")
    assert words([0.001, 0.002]).endswith(", 0.00 (95 %: 0.00 to +0.01), d 2.1: no difference shown; 5 % would have been shown")
    assert words([0.001, 0.001, 0.0011]).endswith("ATE 10.00 -> 10.00 mm, 0.00 (95 %: 0.00 to 0.00), d 17.9: equal")
    assert words([0.25]).endswith("ATE 10.00 -> 10.25 mm, +0.25: one recording, no interval")


def test_one_recording_has_no_verdict_in_a_figure_without_frames():
    pair = (Sample({"ms": 5.0, "ATE mm": 1.0}), Sample({"ms": 6.0, "ATE mm": 2.0}))
    columns = {**ATE, "ms": Column(2, power=0)}
    assert [(one.figure, one.answer) for one in verdicts_of({("a", "b"): [pair]}, columns)] == [("ATE mm", "one recording, no interval")]
    assert [one.figure for one in verdicts_of({("a", "b"): [pair, pair]}, columns)] == ["ATE mm", "ms"]


def test_the_words_of_a_short_recording():
    a, b = errors(np.random.default_rng(0), 120, 0.0, 1.0, 1.3)
    (found,) = verdicts_of({("as recorded", "bundle=none loop=none"): [(sample(a), sample(b))]}, ATE)
    pattern = r"as recorded against bundle=none loop=none: ATE 0\.98 -> 1\.32 mm, \+0\.\d\d \(4 blocks of 30 frames\): too short to tell"
    assert re.fullmatch(pattern, line_of(found, ATE["ATE mm"]))
    assert found.low is None and found.corrected is None and found.effect is None
    (same,) = verdicts_of({("a", "b"): [(sample(a), sample(a))]}, ATE)
    assert same.answer == "equal"


def test_the_names_of_a_pair():
    assert comparison_name("planes.angle_deg=2", "planes.angle_deg=3") == "planes.angle_deg=2 against 3"
    assert comparison_name("as recorded", "bundle=none") == "as recorded against bundle=none"
    assert comparison_name("bundle=none", "bundle=none loop=none") == "bundle=none against bundle=none loop=none"
