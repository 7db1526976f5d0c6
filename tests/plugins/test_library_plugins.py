"""Plugins over COLMAP, Open3D and SciPy do what they say; their system tracks the room."""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import rotation_angle_deg
from trihedron.pipeline.core.types import Camera
from trihedron.pipeline.run.scheduler import single_threaded_libraries
from trihedron.plugins.keypoints.opencv_orb import OpenCvOrb
from trihedron.plugins.keypoints.sift import Sift
from trihedron.plugins.loop.bag_of_words import as_vectors
from trihedron.plugins.pose.open3d_odometry import OdometryMethod, Open3dOdometry, halve_rgbd
from trihedron.tools.plugin_check import PluginCheck, room, values_of

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


def scene(outliers):
    """200 points with their pixels under a known pose, of which the first `outliers` are wrong."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 5.0], (200, 3))
    R, t = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), np.array([0.2, -0.1, 0.3])
    pixels = CAMERA.project(points @ R.T + t) + rng.normal(0.0, 0.3, (200, 2))
    pixels[:outliers] = rng.uniform([0, 0], [640, 480], (outliers, 2))
    return points, pixels, R, t


def test_colmap_recovers_a_pose_among_outliers_with_pixel_centres_at_integers():
    from trihedron.plugins.shared.pycolmap_pose import absolute_pose

    points, pixels, R, t = scene(outliers=60)
    found = absolute_pose(points, pixels, CAMERA, 4.0, seed=3)
    assert rotation_angle_deg(found.R @ R.T) < 0.05 and np.linalg.norm(found.t - t) < 0.005
    assert found.inliers[60:].mean() > 0.98 and found.inliers[:60].mean() < 0.05
    again = absolute_pose(points, pixels, CAMERA, 4.0, seed=3)
    assert again.R.tobytes() == found.R.tobytes() and again.inliers.tobytes() == found.inliers.tobytes()
    assert absolute_pose(points[:3], pixels[:3], CAMERA, 4.0, seed=3) is None


@pytest.mark.slow
@pytest.mark.parametrize(("keypoints", "median_deg"), [("opencv_orb", 0.6), ("sift", 0.1)])
def test_colmap_tracks_with_descriptors_of_either_metric(keypoints, median_deg):
    """OpenCV's ORB places corners to whole pixels of a pyramid level, several of the image."""
    data = Synthetic(length=8, width=320, height=240)
    tracks = values_of(PluginCheck("tracks", "pycolmap_pnp").plugin, "tracks", room((f"keypoints={keypoints}",)))
    assert tracks[0] is None and all(len(found.keypoints) >= 30 for found in tracks[1:])
    truths = [invert(data.true_pose(k)) @ data.true_pose(k - 1) for k in range(1, 8)]
    assert np.median([rotation_angle_deg(found.R_current_previous @ T[:3, :3].T) for found, T in zip(tracks[1:], truths)]) < median_deg


@pytest.mark.parametrize("name", ["open3d_odometry"])
def test_odometry_is_equal_for_any_number_of_calls_at_once(name):
    """Twelve calls on four threads, whose images lie at other addresses."""
    plugin, frames = Open3dOdometry(), [Synthetic(length=2, width=160, height=120)(k) for k in range(2)]
    first = plugin(frames[0], None, None)
    with ThreadPoolExecutor(4) as pool, single_threaded_libraries():
        poses = list(pool.map(lambda _: plugin(frames[1], frames[0], first), range(12)))
    assert len({(pose.T_world_camera.tobytes(), pose.covariance.tobytes()) for pose in poses}) == 1


@pytest.mark.parametrize("name", ["open3d_odometry"])
def test_odometry_by_levels_is_that_of_one_call(name):
    """Without brightness, of which Open3D's images are rounded by address, it is one call of Open3D for all levels."""
    from trihedron.plugins.shared.libraries import open3d
    from trihedron.plugins.shared.open3d_clouds import rgbd_image

    plugin, frames = Open3dOdometry(OdometryMethod.point_to_plane), [Synthetic(length=2, width=161, height=123)(k) for k in range(2)]
    pose = plugin(frames[1], frames[0], plugin(frames[0], None, None))
    odometry, tensor = open3d().t.pipelines.odometry, open3d().core.Tensor
    source, target = (rgbd_image(frame.color, frame.depth_m) for frame in reversed(frames))
    criteria = [odometry.OdometryConvergenceCriteria(count, 1e-6, 1e-6) for count in (10, 5, 3)]
    losses = odometry.OdometryLossParams(depth_outlier_trunc=0.07)
    given = source, target, tensor(frames[0].camera.K), tensor(np.eye(4)), 1.0, 6.0, criteria, odometry.Method.PointToPlane, losses
    assert np.abs(pose.T_world_camera - odometry.rgbd_odometry_multi_scale(*given).transformation.numpy()).max() < 1e-9


def test_depth_is_halved_without_a_mean_over_an_edge():
    """A wall 2 m away, one 3 m away, and a column without depth; jumps beyond 0.1 m are edges."""
    depth = np.full((9, 13), 2.0, np.float32)
    depth[:, 6:], depth[:, 10] = 3.0, 0.0
    color = np.full((9, 13, 3), 200, np.uint8)
    smaller, halves = halve_rgbd(color, depth, 0.1)
    assert smaller.shape == (4, 6, 3) and (smaller == 200).all()
    assert np.array_equal(halves, np.tile(np.float32([2, 2, 2, 3, 3, 0]), (4, 1)))


def world_points(frame, T):
    """(n, 3) all readings of a frame."""
    rows, columns = np.nonzero(frame.depth_m > 0.0)
    points = frame.camera.back_project(np.stack([columns, rows], axis=1).astype(float), frame.depth_m[rows, columns].astype(float))
    return points @ T[:3, :3].T + T[:3, 3]


@pytest.mark.parametrize(("name", "words", "furthest_m"), [("open3d_voxels", (), 0.1), ("open3d_poisson", ("surface.depth=7",), 0.045)])
def test_surfaces_of_open3d_lie_on_the_depth_and_end_with_it(name, words, furthest_m):
    seen = room(())
    (mesh,) = values_of(PluginCheck("surface", name, words).plugin, "surface", seen)
    tree = cKDTree(np.concatenate([world_points(values["dataset"], values["pose"].T_world_camera) for values in seen.values]))
    distance, _ = tree.query(mesh.vertices_m)
    assert len(mesh.triangles) > 5000 and np.median(distance) < 0.01 and distance.max() < furthest_m
    assert (mesh.instances == -1).all() and not (mesh.colors == 128).all()


def test_words_are_made_of_binary_and_of_histogram_descriptors():
    frame = Synthetic(length=1, width=320, height=240)(0)
    binary, histogram = OpenCvOrb()(frame).descriptors, Sift()(frame).descriptors
    assert as_vectors(binary).shape == (len(binary), 256) and set(np.unique(as_vectors(binary))) == {0.0, 1.0}
    assert as_vectors(histogram).shape == histogram.shape and np.array_equal(as_vectors(histogram), histogram)


@pytest.mark.slow
def test_the_system_of_libraries_tracks_the_room(tmp_path):
    words = ["graph=libraries", "dataset.length=40", "outputs=[trajectory,surface]", f"out={tmp_path}"]
    done = subprocess.run([sys.executable, "-m", "trihedron", "run", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["final"]["tracked_share"] == 1.0 and metrics["final"]["ate_rmse_m"] < 0.03
    assert (tmp_path / "surface.ply").stat().st_size > 100_000
