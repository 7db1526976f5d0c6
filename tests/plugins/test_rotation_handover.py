"""The whole program on the rendered room while the Manhattan frame is out of sight for 40 frames: no jump when it goes, none when it returns."""

from dataclasses import dataclass

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core import registry
from trihedron.pipeline.core.lie import log_so3
from trihedron.pipeline.core.types import ManhattanFrame, Normals, Planes, Segments
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth
from trihedron.plugins.manhattan.mean_shift import MeanShift

FIRST, LAST, LENGTH = 40, 80, 110


@pytest.fixture
def blinking():
    """An estimator that says nothing in frames FIRST to LAST - 1."""

    @registry.register("manhattan", "blinking")
    @dataclass(frozen=True)
    class Blinking(MeanShift):
        """Mean shift with a gap."""

        def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame | None:
            return None if FIRST <= normals.index < LAST else MeanShift.__call__(self, normals, segments, planes, previous)

    yield
    registry._PLUGINS["manhattan"].pop("blinking")


def errors_of(path):
    """(n, 3) rotation errors (deg, camera frame), (n,) squared in units of the covariance, sources and known frames of each rotation."""
    recording = Recording(path)
    truth = attached_truth(recording.attachments, str(path))
    found = list(recording.values("rotation"))
    errors, squares = [], []
    for value in found:
        R = truth.poses[0, :3, :3].T @ truth.poses[int(np.searchsorted(truth.stamps_ns, value.stamp_ns)), :3, :3]
        phi = log_so3(value.R_world_camera.T @ R)
        errors.append(np.degrees(phi))
        squares.append(phi @ np.linalg.solve(value.covariance + 1e-18 * np.eye(3), phi) / 3.0)
    return np.array(errors), np.array(squares[1:]), [value.source for value in found], [value.ids.tolist() for value in found]


@pytest.mark.slow
@pytest.mark.parametrize("graph,largest_step_deg", [("structural_no_refine", 0.35), ("structural", 0.2)])
def test_a_stretch_without_a_manhattan_frame(blinking, tmp_path, graph, largest_step_deg):
    assert main(["run", f"graph={graph}", "manhattan=blinking", f"dataset.length={LENGTH}", f"out={tmp_path}"]) == 0
    errors, squares, sources, ids = errors_of(tmp_path / "run.mcap")
    size = np.linalg.norm(errors, axis=1)
    assert set(sources[1:FIRST]) == {"manhattan"} == set(sources[LAST:]) and set(sources[FIRST:LAST]) == {"tracks"}
    assert all(known == [0] for known in ids[1:])  # it is recognised when it returns
    steps = np.linalg.norm(np.diff(errors, axis=0), axis=1)  # what the rotation moves besides the camera
    assert steps.max() < largest_step_deg
    assert size[10:FIRST].max() < 0.2 and size[FIRST:LAST].max() < 0.5 and size[LAST + 3 :].max() < 0.2
    assert np.mean(squares) < 1.0  # never more certain than right


@pytest.mark.slow
@pytest.mark.parametrize("plugin", ["drift_free", "procrustes", "constant_velocity"])
def test_covariance_on_the_rendered_room(tmp_path, plugin):
    """The normalised error, 1 when the covariance is exact: none is overconfident, none by more than a factor ten in standard deviations timid."""
    assert main(["run", f"rotation={plugin}", "dataset.length=60", f"out={tmp_path}"]) == 0
    squares = errors_of(tmp_path / "run.mcap")[1]
    assert 0.01 < np.mean(squares) < 1.0
