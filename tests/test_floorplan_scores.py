"""Rooms, corners and angles counted as methods that are judged on Structured3D count them."""

from __future__ import annotations

import pytest
import shapely

from trihedron.comparison.floorplan_scores import Score, floorplan_scores

TRUE = [shapely.box(0, 0, 4, 5), shapely.box(4.1, 0, 10, 5)]  # 10 m: a corner is right within 0.39 m


def test_a_right_plan_has_full_scores():
    scores = floorplan_scores([TRUE[1], TRUE[0]], TRUE)
    assert {name: (score.precision, score.recall, score.f1) for name, score in scores.items()} == {name: (1.0, 1.0, 1.0) for name in scores}


def test_corners_on_a_straight_line_count_neither_way():
    with_more = shapely.Polygon([(0, 0), (2, 0), (4, 0), (4, 5), (0, 5)])
    assert floorplan_scores([with_more, TRUE[1]], TRUE)["corner"] == Score(8, 8, 8)


def test_a_wardrobe_that_became_a_wall_costs_corners():
    front = shapely.Polygon([(0, 0), (4, 0), (4, 2), (3.4, 2), (3.4, 4), (4, 4), (4, 5), (0, 5)])
    scores = floorplan_scores([front, TRUE[1]], TRUE)
    assert scores["room"].f1 == 1.0 and scores["corner"] == Score(8, 12, 8) and scores["corner"].f1 == pytest.approx(0.8)


@pytest.mark.parametrize(("away_m", "right"), [(0.38, 4), (0.40, 2)])
def test_a_corner_is_right_within_ten_pixels(away_m, right):
    moved = shapely.box(0, 0, 4 - away_m, 5)
    assert floorplan_scores([moved], TRUE)["corner"] == Score(right, 4, 8)


def test_an_angle_is_right_within_five_degrees():
    slanted = shapely.Polygon([(0, 0), (4, 0), (4, 5), (0, 4.7)])  # 4.3° at two corners
    more = shapely.Polygon([(0, 0), (4, 0), (4, 5), (0, 4.63)])  # 5.3°
    assert floorplan_scores([slanted], TRUE)["angle"].right == 4
    assert floorplan_scores([more], TRUE)["angle"].right == 2 and floorplan_scores([more], TRUE)["corner"].right == 4


def test_a_room_that_overlaps_another_or_is_elsewhere_is_wrong():
    assert floorplan_scores([TRUE[0], shapely.box(2, 0, 10, 5)], TRUE)["room"] == Score(0, 2, 2)
    assert floorplan_scores([shapely.box(0, 0, 1.9, 5)], TRUE)["room"] == Score(0, 1, 2)
    assert floorplan_scores([], TRUE)["corner"] == Score(0, 0, 8)
