"""Association of stamps, and trajectory files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trihedron.datasets.readers.association import associate, pairs_with_delay
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import Trajectory
from trihedron.pipeline.record.trajectories import format_stamp, parse_stamp_ns, read_trajectory, write_trajectory


def greedy(first: np.ndarray, second: np.ndarray, limit: int) -> list[list[int]]:
    """The rule in words: all candidates sorted by difference, each taken when both its ends are still free."""
    candidates = sorted((abs(int(a - b)), i, j) for i, a in enumerate(first) for j, b in enumerate(second) if abs(a - b) < limit)
    rows, columns, chosen = set(), set(), []
    for _, i, j in candidates:
        if i not in rows and j not in columns:
            rows.add(i)
            columns.add(j)
            chosen.append([i, j])
    return sorted(chosen)


@pytest.mark.parametrize("seed", range(20))
def test_association_is_the_greedy_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = (np.unique(rng.integers(0, 400, size=rng.integers(1, 60))) for _ in range(2))
    limit = int(rng.integers(1, 30))
    found = associate(first, second, limit)
    assert found.tolist() == greedy(first, second, limit)


def test_association_is_one_to_one_and_strict() -> None:
    pairs = associate(np.array([0, 100, 200]), np.array([19, 95, 108, 220]), 20)
    assert pairs.tolist() == [[0, 0], [1, 1]]
    assert associate(np.array([0]), np.array([], dtype=np.int64), 20).shape == (0, 2)


def test_stamps_are_exact() -> None:
    assert parse_stamp_ns("1341836537.655691001") == 1_341_836_537_655_691_001  # a float keeps 10 digits less
    assert format_stamp(1_341_836_537_655_691_001) == "1341836537.655691001"
    assert parse_stamp_ns(format_stamp(-1)) == -1


def test_a_trajectory_comes_back_from_its_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    stamps = np.sort(rng.integers(10**18, 2 * 10**18, size=50))
    poses = np.array([exp_se3(rng.uniform(-2, 2, size=6)) for _ in stamps])
    write_trajectory(tmp_path / "t.txt", Trajectory(stamps, poses))
    found = read_trajectory(tmp_path / "t.txt")
    assert (found.stamps_ns == stamps).all()
    np.testing.assert_allclose(found.poses, poses, atol=5e-9)


def test_blank_lines_comments_tabs_and_commas_are_understood(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("# head\n\n1.5\t1,2,3 0 0 0 2 # end\n")
    found = read_trajectory(tmp_path / "t.txt")
    assert found.stamps_ns.tolist() == [1_500_000_000]
    np.testing.assert_array_equal(found.poses[0], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def test_a_known_delay_pairs_the_images_of_one_time_unless_that_loses_many() -> None:
    stamps = 100 * np.arange(20)
    assert pairs_with_delay(stamps, stamps, 30, 100e-9).tolist() == [[k + 1, k] for k in range(19)]  # depth of a frame later
    assert pairs_with_delay(stamps, stamps, 30, 40e-9).tolist() == [[k, k] for k in range(20)]  # none is within 30 ns
    assert pairs_with_delay(stamps, stamps, 30, 300e-9).tolist() == [[k, k] for k in range(20)]  # three of twenty
