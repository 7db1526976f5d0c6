"""`trihedron benchmark manhattan`: what counts as in view is told by exact normals; what the estimators promise on rendered rooms."""

import json

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.registry import load_plugins
from trihedron.pipeline.core.types import ManhattanFrame
from trihedron.plugins.manhattan.branch_and_bound import BranchAndBound
from trihedron.plugins.manhattan.modes import directions_of
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE
from trihedron.tools.benchmarks import manhattan_views as seen
from trihedron.tools.benchmarks.manhattan_family import error_of, estimators, figures, measure


def frame(*rotations, inliers=9):
    k = len(rotations)
    return ManhattanFrame(
        0, 0, np.array(rotations), np.arange(k, dtype=np.int32), np.tile(np.eye(3), (k, 1, 1)), np.full((k, 3), inliers, np.int32),
        np.zeros((k, 3)), True,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scenes():
    load_plugins()
    return seen.scenes()


def test_the_error_knows_no_names_of_axes_and_only_frames_in_view():
    truth = exp_so3(np.array([0.3, -1.2, 0.4]))
    for S in CUBE:
        degrees, square = error_of(frame(exp_so3(np.radians([0.0, 2.0, 0.0])) @ truth @ S), truth)
        assert degrees == pytest.approx(2.0, abs=1e-6) and square == pytest.approx(np.radians(2.0) ** 2)  # its covariance is 1
    assert error_of(None, truth)[0] == 180.0 == error_of(frame(truth, inliers=0), truth)[0]
    assert error_of(frame(np.eye(3), truth), truth)[0] == pytest.approx(0.0, abs=1e-5)


def test_no_two_surfaces_of_the_leaning_room_are_at_right_angles(scenes):
    n = scenes[seen.LEANING].normals
    angles = np.degrees(np.arccos(np.clip(n @ n.T, -1.0, 1.0)))
    parallel = (angles < 0.1) | (angles > 179.9)
    assert len(n) == 6 and parallel.sum() == 12 and (abs(angles - 90.0) > 10.0).all()
    flat = np.array([face.u @ face.normal for face in scenes[seen.LEANING].room.faces])
    assert abs(flat).max() < 1e-12


def test_right_angles_in_view_are_told_by_exact_normals(scenes):
    scene = scenes[seen.SLANTED]
    south, east, north, floor = 0, 1, 2, 4
    for pair, expected in (((south, east), False), ((north, south), False), ((south, floor), True), ((east, floor), True), ((north,), False)):
        assert scene.shows_right_angle(np.repeat(np.array(pair, np.int32), 50)) == expected
    mostly = np.repeat(np.array([south, east, floor], np.int32), (500, 495, 5))  # half a percent of floor carries nothing
    assert not scene.shows_right_angle(mostly)
    assert scenes[seen.WHOLE].shows_right_angle(np.repeat(np.array([0, 1], np.int32), 50))


def test_the_parts_of_a_view_hold_what_their_names_say(scenes):
    counts = dict.fromkeys(seen.CASES, 0)
    for index in range(6):
        for _, view in seen.views(scenes[seen.WHOLE], index, False):
            on = np.abs(np.nan_to_num(view.normals.normals) @ view.truth) > np.cos(np.radians(10.0))
            right = np.take_along_axis(on, np.maximum(view.axes, 0)[..., None].astype(int), axis=2)[..., 0]
            flat = (view.axes >= 0) & np.isfinite(view.normals.normals[..., 0])
            assert right[flat].mean() > 0.8  # the exact axes are those of the pixels that the normals belong to
            for case in seen.CASES:
                part = seen.case_of(view, case)
                counts[case] += part is not None
                if part is None:
                    continue
                finite = np.isfinite(part.normals.normals[..., 0])
                lines, planes = len(part.segments.endpoints_m), len(part.planes.pixels)
                shown = np.unique(part.axes[finite])
                if case in ("three planes", "two planes"):
                    assert lines == 0 and planes >= 1 and list(shown[shown >= 0]) == list(shown) and len(shown) == (3 if case[1] == "h" else 2)
                if case == "lines only":
                    assert planes == 0 and not finite.any() and lines > 0 and (part.lines_on_axes >= seen.AXIS_LINES).sum() >= 2
                if case == "one plane + lines":
                    assert planes == 1 and set(np.unique(part.planes.labels)) == {0, 1} and finite.sum() <= (part.planes.labels == 1).sum()
                if case == seen.CLUTTER:
                    same = (part.normals.normals == view.normals.normals).all(axis=2)[finite]
                    assert 0.47 < same.mean() < 0.53 and (part.planes.pixels <= view.planes.pixels // 2).all()
    assert min(counts.values()) > 0


@pytest.mark.slow
def test_few_views_and_one_estimator(tmp_path, capsys):
    assert main(["benchmark", "manhattan", "--orientations", "3", "--estimators", "mean_shift", "--json", str(tmp_path / "f.json")]) == 0
    said = capsys.readouterr().out
    assert "mean_shift, lines only" in said and "50 % clutter" in said and "leaning, noisy (3)" in said
    saved = json.loads((tmp_path / "f.json").read_text())
    rows = {(row["estimator"], row["depth"], row["case"], row["start"]): row for row in saved["rows"]}
    assert rows["mean_shift", "clean", "whole", "near"]["within_1_deg"] == 1.0 and saved["reference_ms"] > 0.0
    assert rows["mean_shift, lines only", "clean", "two planes", "none"]["claimed"] == 0.0
    assert main(["benchmark", "manhattan", "--estimators", "mean_shit"]) == 2
    assert "mean_shift" in capsys.readouterr().err
    assert main(["benchmark", "manhattan", "--orientations", "0"]) == 2


def consensus(vectors, weights, rotations, inlier):
    """C of each of (m, 3, 3) rotations, from the definition."""
    square = np.max(np.einsum("ni,mik->mnk", vectors, rotations) ** 2, axis=2)
    return np.maximum(square - np.cos(inlier) ** 2, 0.0) @ weights / np.sin(inlier) ** 2


def test_the_gap_is_not_refuted_by_a_grid_over_all_rotations(scenes):
    """Rendered, noisy views: no rotation of a grid, and none near its best, has more consensus than the one returned and its gap allow."""
    estimator, rng = BranchAndBound(), np.random.default_rng(0)
    ticks = np.radians(np.arange(-45.0, 45.1, 7.5))  # rotation vectors that hold an equivalent of every rotation
    grid = np.array([exp_so3(np.array(v)) for v in np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)])
    for index in range(3):
        _, view = list(seen.views(scenes[seen.WHOLE], index, False))[1]
        found = estimator(view.normals, view.segments, view.planes, None)
        directions = directions_of(estimator, view.normals, view.segments)
        vectors, weights = estimator._with_planes(directions.subsample(estimator.search_samples), view.planes)
        inlier = np.radians(estimator.inlier_deg)
        reached = consensus(vectors, weights, found.rotations, inlier)[0]
        values = np.concatenate([consensus(vectors, weights, part, inlier) for part in np.array_split(grid, 20)])
        best = grid[np.argsort(-values)[:4]]
        for size in (4.0, 2.0, 1.0, 0.5, 0.25):
            turns = [exp_so3(np.radians(size) * rng.normal(size=3)) @ R for R in best for _ in range(40)]
            best = np.array([*best, *turns])
            best = best[np.argsort(-consensus(vectors, weights, best, inlier))[:4]]
        highest = consensus(vectors, weights, best, inlier)[0]
        assert found.supported and 0.0 <= found.gap < 0.02
        assert highest >= values.max() and 0.98 * reached < highest <= reached * (1.0 + found.gap)


def promises(count):
    load_plugins()
    rows = figures(measure(estimators(["mean_shift", "branch_and_bound"]), count, (seen.WHOLE, "three planes", "two planes")))
    return {(row["estimator"], row["depth"], row["case"], row["start"]): row for row in rows}


def test_promises_where_two_axes_are_visible():
    for (name, _, _, start), row in promises(8).items():
        if name == "branch_and_bound" or (name == "mean_shift" and start == "near"):
            assert row["within_1_deg"] == 1.0, row


@pytest.mark.slow
def test_promises_at_a_thousand_orientations():
    """Where two axes are visible: branch and bound from anywhere in 99.9 % within 1°, mean shift from up to 10° off in 99 %."""
    least = {"branch_and_bound": 0.999, "mean_shift": 0.99}
    rows = [row for (name, _, _, start), row in promises(1000).items() if name == "branch_and_bound" or (name == "mean_shift" and start == "near")]
    assert len(rows) == 18 and all(row["views"] > 150 for row in rows)
    short = [row for row in rows if row["within_1_deg"] < least[row["estimator"]]]
    assert not short, short


@pytest.mark.slow
def test_no_false_claims_at_two_hundred_orientations():
    """On views without a Manhattan frame, by each estimator."""
    load_plugins()
    for row in figures(measure(estimators(), 200, seen.WITHOUT_FRAME)):
        assert row["claimed"] <= 0.02, row
