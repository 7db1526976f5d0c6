"""Statistics of ablations on known figures."""

import pytest

from trihedron.comparison.attribution import shapley_weights
from trihedron.pipeline.sweep.paired_statistics import half_interval, half_width, holm, p_value, power, repeats_needed


def shapley(worth, players):
    return {player: sum(weight * worth[some] for some, weight in weights.items()) for player, weights in shapley_weights(players).items()}


def test_shapley_values_of_the_glove_game():
    """Two left gloves a and b, one right glove c; a pair is worth 1: 1/6, 1/6 and 2/3."""
    worth = {frozenset(some): float("c" in some and len(some) > 1) for some in ("", "a", "b", "c", "ab", "ac", "bc", "abc")}
    assert shapley(worth, "abc") == pytest.approx({"a": 1 / 6, "b": 1 / 6, "c": 2 / 3})


def test_shapley_values_sum_to_the_whole_and_divide_an_interaction_equally():
    worth = {frozenset(): 5.0, frozenset("a"): 7.0, frozenset("b"): 4.0, frozenset("ab"): 10.0}
    found = shapley(worth, "ab")
    assert found == pytest.approx({"a": 4.0, "b": 1.0}) and sum(found.values()) == pytest.approx(5.0)


def test_holm_on_four_known_p_values():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0] and holm([]) == []


@pytest.mark.parametrize(("effect", "pairs"), [(0.5, 34), (0.8, 15), (0.2, 199), (-0.5, 34)])
def test_repeats_needed_are_those_of_the_tables(effect, pairs):
    """Cohen, 1988, and G*Power: two-sided paired t test, 5 %, power 80 %."""
    assert repeats_needed(effect) == pairs


def test_repeats_needed_at_the_ends():
    assert repeats_needed(50.0) == 2 and repeats_needed(1e-4) is None


def test_intervals_and_p_values_by_student():
    """Of 1, 2, 3, 4: mean 2.5, deviation 1.290994, three degrees of freedom."""
    assert half_interval([1.0, 2.0, 3.0, 4.0]) == pytest.approx(3.182446 * 1.290994 / 2.0, rel=1e-6) and half_interval([1.0]) is None
    assert half_width(2.0, 3) == pytest.approx(2.0 * 3.182446, rel=1e-6)
    assert p_value(2.5, 1.290994 / 2.0, 3) == pytest.approx(0.030466, rel=1e-4) == p_value(-2.5, 1.290994 / 2.0, 3)
    assert (p_value(0.0, 0.0, 3), p_value(0.1, 0.0, 3)) == (1.0, 0.0)


def test_power_grows_with_the_difference_and_falls_with_the_level():
    assert power(0.0, 9) == pytest.approx(0.025) and power(50.0, 9) == 1.0  # one side of the two
    assert power(3.0, 9, 0.01) < power(3.0, 9) < power(4.0, 9)
