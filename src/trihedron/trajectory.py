"""The trajectory of the Python API."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from trihedron.pipeline.core import types
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.record.trajectories import write_trajectory
from trihedron.pipeline.run.results import flatten_dict


class Trajectory(types.Trajectory):
    """Poses over time: `stamps_ns` (n,) and `poses` (n, 4, 4), `T_world_camera`.

    Args:
        stamps_ns: (n,) times, ns, increasing.
        poses: (n, 4, 4) `T_world_camera`, metres.
    """

    @classmethod
    def of(cls, trajectory: types.Trajectory) -> Trajectory:
        """Make one of the library's.

        Args:
            trajectory: as of a data set's `truth()`.

        Returns:
            The same poses, in the same arrays.
        """
        return cls(trajectory.stamps_ns, trajectory.poses)

    def to_tum(self, path: str | Path) -> None:
        """Write `stamp tx ty tz qx qy qz qw` a line, seconds and metres.

        Args:
            path: the file, in a folder that exists; it is overwritten.

        Raises:
            DataError: the file cannot be written.

        Examples:
            >>> import numpy as np
            >>> import trihedron as th
            >>> th.Trajectory(np.array([500_000_000]), np.eye(4)[None]).to_tum("trajectory.txt")
            >>> print(open("trajectory.txt").read().splitlines()[1])
            0.500000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000
        """
        file = Path(path).expanduser()
        try:
            write_trajectory(file, self)
        except OSError as error:
            raise DataError(str(file), f"cannot be written: {error.strerror}", "give another path") from error

    def errors(self, truth: types.Trajectory) -> dict[str, Any]:
        """Return the errors against a true trajectory as in metrics.json: `ate_rmse_m`, `rpe_second_rmse_m` and others.

        Args:
            truth: at any rate and in any world frame; a pose is compared with the truth at most 20 ms from it.

        Returns:
            Name to figure, m and degrees; the ATE is that after the best rigid alignment, an RPE None where no two poses are so far apart.

        Raises:
            DataError: fewer than three poses have truth, a pose is not finite, or stamps do not increase.

        Examples:
            >>> import numpy as np
            >>> import trihedron as th
            >>> truth = th.dataset.synthetic(length=30, width=160, height=120).truth()
            >>> moved = truth.poses.copy()
            >>> moved[:, :3, 3] += 1.0  # another world, which the alignment takes out
            >>> errors = th.Trajectory(truth.stamps_ns, moved).errors(truth)
            >>> errors["ate_rmse_m"] < 1e-9, errors["tracked_share"]
            (True, 1.0)
        """
        from trihedron.pipeline.run.metrics import evaluate_trajectory

        return flatten_dict(evaluate_trajectory(self, truth).to_dict())
