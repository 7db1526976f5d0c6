"""The trajectory of the Python API."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from trihedron.pipeline.core import types
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.record.trajectories import write_trajectory
from trihedron.pipeline.run.results import flatten_dict


class Trajectory(types.Trajectory):
    """Poses over time: `stamps_ns` (n,) and `poses` (n, 4, 4), `T_world_camera`."""

    @classmethod
    def of(cls, trajectory: types.Trajectory) -> Trajectory:
        """Make one of the library's."""
        return cls(trajectory.stamps_ns, trajectory.poses)

    def to_tum(self, path: str | Path) -> None:
        """Write `stamp tx ty tz qx qy qz qw` a line, seconds and metres. Raises TrihedronError where the file cannot be written."""
        file = Path(path).expanduser()
        try:
            write_trajectory(file, self)
        except OSError as error:
            raise DataError(str(file), f"cannot be written: {error.strerror}", "give another path") from error

    def errors(self, truth: types.Trajectory) -> dict[str, Any]:
        """Return the errors against a true trajectory as in metrics.json: `ate_rmse_m`, `rpe_second_rmse_m` and others. Raises TrihedronError."""
        from trihedron.pipeline.run.metrics import evaluate_trajectory

        return flatten_dict(evaluate_trajectory(self, truth).to_dict())
