"""Planes turn as the camera does by its points and lines, or contradict it."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trihedron.pipeline.core.types import EXACT_CALIBRATION, CalibrationSigmas, Camera, Pose
from trihedron.plugins.pose.judgement import judge_by_run
from trihedron.plugins.shared.plane_turns import contradicting_turn, with_turn_difference
from trihedron.plugins.shared.plane_turns_kernels import rotation_of_normals

NORMALS = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.6, 0.0, -0.8]])
TURN = Rotation.from_rotvec([0.1, -0.3, 0.2]).as_matrix()  # of the camera, from the first frame to the second
CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
PRIOR, VARIANCE = np.deg2rad(1.0), np.deg2rad(0.05) ** 2


def shown(vector, before=NORMALS, wrong=None):
    """Rotation that planes show which turned by a rotation vector (3,) beyond the camera's turn, of `before` (n, 3); one of them may be wrong."""
    now = before @ TURN @ Rotation.from_rotvec(vector).as_matrix().T
    if wrong is not None:
        now[wrong] = now[wrong] @ Rotation.from_rotvec([0.0, 0.1, 0.1]).as_matrix()
    now[1::2] *= -1.0  # a normal's sign is that of its own frame
    return rotation_of_normals(before, np.ascontiguousarray(now), np.full(len(before), VARIANCE), np.ones(len(before)), TURN, PRIOR)


@pytest.mark.parametrize("degrees", [(0.4, 0.0, 0.0), (0.1, -0.3, 0.2), (0.0, 0.0, 0.0)])
def test_the_rotation_that_normals_show(degrees):
    vector = np.deg2rad(degrees)
    assert shown(vector) == pytest.approx(vector, abs=0.01 * np.linalg.norm(vector) + 1e-9)
    assert shown(vector, wrong=3) == pytest.approx(vector, abs=np.deg2rad(0.02))


def test_what_no_plane_shows_is_no_difference():
    """A floor and a ceiling show no rotation about their normal."""
    vector = np.deg2rad([0.3, 0.4, 0.0])
    along = TURN.T @ NORMALS[0]
    assert shown(vector, NORMALS[[0, 0]]) == pytest.approx(vector - (vector @ along) * along, abs=np.deg2rad(0.01))


def turned(planes_deg, camera_deg, camera=CAMERA, **frame):
    """The pose after frames in which planes and camera are turned by such angles (n,) about the y axis."""
    pose = Pose(0, 0, np.eye(4), np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", "")
    for index in range(1, len(planes_deg)):
        before, now = (NORMALS @ Rotation.from_euler("y", planes_deg[n], degrees=True).as_matrix() for n in (index - 1, index))
        T, twist = np.eye(4), np.zeros(6)
        T[:3, :3] = Rotation.from_euler("y", camera_deg[index], degrees=True).as_matrix()
        twist[4] = np.radians(camera_deg[index] - camera_deg[index - 1]) * camera.fps
        covariance = np.tile(np.diag([VARIANCE, VARIANCE, 1e-6]), (len(NORMALS), 1, 1))
        tracks = SimpleNamespace(previous_index=index - 1, planes=np.stack([np.arange(4)] * 2, 1), coefficients=before, plane_covariance=covariance)
        planes = SimpleNamespace(coefficients=now, covariance=covariance, pixels=np.full(len(NORMALS), 1000, np.int32))
        given = {"tracks": tracks, "planes": planes, "camera": camera, **frame}
        pose = with_turn_difference(dataclasses.replace(pose, index=index, T_world_camera=T, twist=twist), pose, **given)
    return pose


def walked(frames, planes_deg, camera_deg, frozen_at=1000, **frame):
    """The pose after so many frames, in each of which the planes and the camera turn by so much; the camera until images freeze."""
    n = np.arange(frames + 1)
    return turned(n * planes_deg, np.minimum(n, frozen_at) * camera_deg, **frame)


@pytest.mark.parametrize("sigmas, contradicted", [(CalibrationSigmas(), False), (EXACT_CALIBRATION, True)])
def test_depth_that_lags_colour_is_no_contradiction(sigmas, contradicted):
    """A camera at rest begins to turn by 60° a second, and depth is 30 ms late: planes turn by 1.8° less, unless time is known exactly."""
    camera = dataclasses.replace(CAMERA, fps=10.0, sigmas=sigmas)
    seconds = np.arange(120) / camera.fps
    planes_deg, camera_deg = (60.0 * np.maximum(seconds - late_s, 0.0) for late_s in (10.03, 10.0))
    reasons = [contradicting_turn(turned(planes_deg[:n], camera_deg[:n], camera)) for n in range(100, 110)]
    assert any(reasons) is contradicted
    if contradicted:
        assert reasons[2] == "colour and depth contradict each other: in 10 frames the planes turned by 1.8° more than points and lines"


def test_frozen_colour_is_a_contradiction():
    """The camera goes on to turn by 0.5° a frame, as the planes show, and points and lines say that it is at rest."""
    reasons = [contradicting_turn(walked(frames, 0.5, 0.5, frozen_at=40)) for frames in range(40, 52)]
    assert not any(reasons[:3]) and all(reasons[6:])
    assert reasons[-1] == "colour and depth contradict each other: in 10 frames the planes turned by 3.4° more than points and lines"
    judged = judge_by_run(walked(51, 0.5, 0.5, frozen_at=40), planes_agree=True)
    assert judged.status == "degraded" and judged.reason == reasons[-1]


@pytest.mark.parametrize("planes_deg, camera_deg", [(0.5, 0.5), (3.0, 3.0), (0.1, 0.0)])
def test_what_turns_alike_is_none(planes_deg, camera_deg):
    """A difference of a tenth of a degree a frame may be a bias of depth."""
    assert not any(contradicting_turn(walked(frames, planes_deg, camera_deg)) for frames in (1, 5, 20, 60))


@pytest.mark.parametrize("frame", [{"tracks": None}, {"tracks": SimpleNamespace(previous_index=-5, planes=np.zeros((4, 2), int))}])
def test_frames_that_cannot_be_compared_change_nothing(frame):
    pose = walked(3, 0.5, 0.0, **frame)
    assert not pose.turn_difference.any() and pose.usual_turn_difference == pytest.approx(np.deg2rad(0.3))
