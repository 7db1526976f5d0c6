"""Error of a pose by an imperfect calibration, against a simulated camera with known errors."""

from dataclasses import replace

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.lie import adjoint, exp_se3, log_se3
from trihedron.pipeline.core.types import CALIBRATION, CalibrationSigmas, Camera, Pose
from trihedron.plugins.loop.manhattan_prior_kernels import Views, line_turns, plane_turns
from trihedron.plugins.pose.calibration_uncertainty import carried_calibration, contradicted_calibration
from trihedron.plugins.shared.calibration_error import calibration_covariance, calibration_scales
from trihedron.plugins.shared.calibration_error_kernels import (
    Keyframes,
    Observers,
    Surfaces,
    calibration_equations,
    calibration_moment,
    keypoint_errors,
    plane_point_error,
    sensitivity_and_evidence,
)
from trihedron.plugins.shared.plane_offsets_kernels import distance_sigmas
from trihedron.plugins.shared.pose_optimizer import NO_LINES, NO_PLANES, solve_pose
from trihedron.plugins.shared.pose_optimizer_kernels import Flags
from trihedron.plugins.shared.residuals_kernels import LineTerms, PlaneTerms, PointTerms

CAMERA = Camera(640, 480, 520.0, 530.0, 315.0, 245.0)
TWIST = np.array([0.3, -0.2, 0.1, 0.2, -0.4, 0.3])
WALLS = np.array([[0.0, 0.0, -1.0, 3.0], [0.6, 0.0, -0.8, 2.5], [0.0, 0.6, -0.8, 2.2]])  # in the world; the camera looks along z


def measured(points, plane, theta, twist):
    """Pixels (n, 2), depth (n,) at them, and the points (n, 3) of a plane as depth alone sees them, by a camera that errs by theta (12,)."""
    fx, fy, cx, cy = CAMERA.intrinsics
    f, c = np.array([fx * (1 + theta[0]), fy * (1 + theta[1])]), np.array([cx + theta[2], cy + theta[3]])
    rows = (fy * points[:, 1] / points[:, 2] + cy) / CAMERA.height - 0.5
    pixels, depth, seen = np.empty((len(points), 2)), np.empty(len(points)), np.empty((len(points), 3))
    for i, (point, row) in enumerate(zip(points, rows)):
        rolled = (invert(exp_se3(twist * theta[9] * row)) @ [*point, 1.0])[:3]
        pixels[i] = f * rolled[:2] / rolled[2] + c
        later = exp_se3(twist * (theta[10] + theta[11] * row))
        moved = np.append(later[:3, :3].T @ plane[:3], plane[3] + plane[:3] @ later[:3, 3])

        def reading(ray, radius2, moved=moved):
            z = -moved[3] / (moved[:3] @ ray)
            return 1.0 / ((1.0 / z - theta[7]) / (1.0 + theta[8] * radius2))

        of_depth = f * (1 + theta[4]), c + theta[5:7]
        pixel = CAMERA.project(point[None])[0]
        radius2 = ((pixel - [cx, cy]) ** 2).sum() / (0.25 * (CAMERA.width**2 + CAMERA.height**2))
        depth[i] = reading(np.append((pixels[i] - of_depth[1]) / of_depth[0], 1.0), radius2)
        on_plane = (invert(later) @ [*point, 1.0])[:3]
        at = of_depth[0] * on_plane[:2] / on_plane[2] + of_depth[1]
        z = reading(on_plane / on_plane[2], radius2)
        seen[i] = z * np.append((at - [cx, cy]) / [fx, fy], 1.0)
    return pixels, depth, seen


def test_a_camera_states_the_units_of_its_parameters():
    given = CalibrationSigmas(0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.007, 0.008, 0.009)
    stated = calibration_scales(replace(CAMERA, sigmas=given))
    assert stated == pytest.approx([0.001, 0.001, 1.28, 1.28, 0.003, 2.56, 2.56, 0.005, 0.006, 0.007, 0.008, 0.009])
    assert calibration_scales(CAMERA) == pytest.approx([0.003, 0.003, 1.216, 1.216, 0.003, 1.408, 1.408, 0.002, 0.007, 0.02, 0.012, 0.015])


def points_on(rng, plane, T_world_camera, count):
    """Points (count, 3) of the world on a plane, in view of the camera, and the plane (4,) in the camera frame."""
    local = np.append(T_world_camera[:3, :3].T @ plane[:3], plane[3] + plane[:3] @ T_world_camera[:3, 3])
    rays = CAMERA.back_project(rng.uniform([40, 40], [600, 440], (count, 2)), np.ones(count))
    points = rays * (-local[3] / (rays @ local[:3]))[:, None]
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3], points, local


@pytest.mark.parametrize("parameter", range(CALIBRATION))
def test_errors_of_measurements_are_those_of_a_camera_with_that_error(parameter):
    points, plane = points_on(np.random.default_rng(0), WALLS[1], np.eye(4), 12)[1:]
    step = 1e-4 * calibration_scales(CAMERA)[parameter] * np.eye(CALIBRATION)[parameter]
    (pixels, depth, seen), (pixels2, depth2, seen2) = (measured(points, plane, sign * step, TWIST) for sign in (1.0, -1.0))
    errors, along = np.empty((3, CALIBRATION)), np.empty(CALIBRATION)
    for i, point in enumerate(points):
        keypoint_errors(point, plane, TWIST, CAMERA.intrinsics, CAMERA.width, CAMERA.height, errors)
        plane_point_error(point, plane, TWIST, CAMERA.intrinsics, CAMERA.width, CAMERA.height, along)
        expected = np.append(pixels[i] - pixels2[i], 1.0 / depth[i] - 1.0 / depth2[i]) / (2.0 * step[parameter])
        assert errors[:, parameter] == pytest.approx(expected, rel=1e-4, abs=1e-6)
        assert along[parameter] == pytest.approx(plane[:3] @ (seen[i] - seen2[i]) / (2.0 * step[parameter]), rel=1e-4, abs=1e-6)


AT_REST = ((np.eye(4), np.zeros(6)),)
NO_ERROR = np.zeros((6, CALIBRATION))
NO_ENDS = np.empty((0, 2, 4))
AT_TRUTH = (np.eye(4),) * 2
MOVING = ((np.eye(4), TWIST[::-1]), (exp_se3(np.array([-0.1, 0.1, 0.0, 0.02, 0.03, 0.05])), -0.5 * TWIST))


def seen_from(T, twist, world, wall, theta):
    """The points (n, 3) of the world as a keyframe at T with this velocity places them."""
    local = world @ T[:3, :3] - T[:3, 3] @ T[:3, :3]
    plane = np.append(T[:3, :3].T @ wall[:3], wall[3] + wall[:3] @ T[:3, 3])
    pixels, depth, _ = measured(local, plane, theta, twist)
    return CAMERA.back_project(pixels, depth) @ T[:3, :3].T + T[:3, 3]


def information_from(T, world):
    """Information (n, 3, 3) that a keyframe at T has of points (n, 3) of the world, by pixels of 1 px and the noise of its depth."""
    x, y, z = ((world - T[:3, 3]) @ T[:3, :3]).T
    J, zero = np.empty((len(z), 3, 3)), np.zeros(len(z))  # of (u, v, z)
    J[:, 0], J[:, 1] = (np.stack(row, axis=1) for row in ((CAMERA.fx / z, zero, -CAMERA.fx * x / z**2), (zero, CAMERA.fy / z, -CAMERA.fy * y / z**2)))
    J[:, 2] = [0.0, 0.0, 1.0]
    J = J @ T[:3, :3].T
    weights = np.stack([np.ones(len(z)), np.ones(len(z)), 1.0 / CAMERA.depth_noise.sigma_m(z) ** 2], axis=1)
    return np.swapaxes(J, 1, 2) @ (weights[:, :, None] * J)


def placed_by(keyframes, world, wall, theta, moved):
    """The points (n, 3) of the world where keyframes, each `moved` by its own motion, place them together: the mean, weighted by information."""
    information = [information_from(T, world) for T, _ in keyframes]
    seen = [transform(motion, seen_from(*keyframe, world, wall, theta)) for keyframe, motion in zip(keyframes, moved)]
    return np.linalg.solve(sum(information), sum(W @ x[:, :, None] for W, x in zip(information, seen)))[:, :, 0]


def two_views(theta, keyframes=AT_REST, moved=AT_TRUTH):
    """Keyframes, each with its pose and velocity, and a camera 0.4 m and 9° from the origin, all with the calibration error theta: the terms of the
    points, which are where the keyframes, `moved` by errors of their poses, place them, the surfaces that they lie on, and the true pose."""
    rng, T = np.random.default_rng(1), exp_se3(np.array([0.3, 0.05, 0.25, 0.05, 0.14, -0.03]))
    terms, surfaces = [], []
    for wall in WALLS:
        world, local, plane = points_on(rng, wall, T, 60)
        landmarks = placed_by(keyframes, world, wall, theta, moved)
        terms.append((landmarks, *measured(local, plane, theta, TWIST)[:2]))
        surfaces.append(np.tile(plane, (60, 1)))
    landmarks, pixels, depth = (np.concatenate(parts) for parts in zip(*terms))
    n = len(landmarks)
    points = PointTerms(landmarks, np.tile(1e-5 * np.eye(3), (n, 1, 1)), pixels, depth, np.full(n, 1.0), 0.003 * depth**2)
    return points, np.concatenate(surfaces), T


def keyframes_of(observers, errors=NO_ERROR):
    """Keyframes that err by the calibration, alike (6, 12) or each by its own, as poses of the camera."""
    T, twists = (np.array(part) for part in zip(*observers))
    errors = np.ascontiguousarray(np.broadcast_to(errors, (len(T), 6, CALIBRATION)))
    return Keyframes(np.ascontiguousarray(T[:, :3, :3]), T[:, :3, 3].copy(), twists, errors, CAMERA.depth_noise.coefficients)


def equations_of(points, surfaces, T, keyframes=AT_REST, errors=NO_ERROR):
    """The equations at pose T of landmarks that all of these keyframes observed."""
    flags = Flags(np.ones(len(surfaces), np.uint8), np.empty(0, np.uint8), np.empty(0, np.uint8))
    seen_by = np.append(np.arange(len(keyframes), dtype=np.int32), np.int32(-1))  # and by none besides
    none = np.empty((0, len(seen_by)), np.int32)
    observers = Observers(np.tile(seen_by, (len(surfaces), 1)), none, none)
    samples, size = np.empty((0, 8, 3), np.float32), (CAMERA.width, CAMERA.height)
    return calibration_equations(
        T, CAMERA.intrinsics, *size, calibration_scales(CAMERA), TWIST, points, NO_LINES, NO_PLANES, flags, Surfaces(surfaces, NO_ENDS), samples,
        observers, keyframes_of(keyframes, errors),
    )  # fmt: skip


@pytest.mark.parametrize("keyframes", [AT_REST, MOVING], ids=["one keyframe", "two moving ones"])
@pytest.mark.parametrize("parameter", range(CALIBRATION))
def test_sensitivity_is_the_error_of_the_pose(parameter, keyframes):
    """The pose estimated from what a miscalibrated camera measures, in all views, is off by the sensitivity times the error."""
    unit = 0.1 * np.eye(CALIBRATION)[parameter]
    points, surfaces, T = two_views(unit * calibration_scales(CAMERA), keyframes)
    solution = solve_pose(T, CAMERA, T, 1e-6 * np.eye(6), points)
    assert (solution.points > 0).all()
    equations = equations_of(points, surfaces, solution.T_world_camera, keyframes)
    expected = -np.linalg.solve(equations.H, equations.C @ unit)
    error = log_se3(invert(T) @ solution.T_world_camera)
    assert error == pytest.approx(expected, rel=0.1, abs=0.03 * np.abs(expected).max() + 1e-6)


@pytest.mark.parametrize("direction", range(6))
def test_a_pose_errs_as_the_keyframes_that_placed_its_landmarks(direction):
    """One of two keyframes errs by 2 mm or 0.1°, and knows more of the landmarks than the other: the camera is off by what they make of it."""
    xi = np.where(np.arange(6) == direction, 0.002 if direction < 3 else np.radians(0.1), 0.0)
    near = exp_se3(np.array([0.2, 0.0, 1.2, 0.0, 0.1, 0.0])), np.zeros(6)
    keyframes = (*AT_REST, near)
    points, surfaces, T = two_views(np.zeros(CALIBRATION), keyframes, (np.eye(4), T_of_camera(xi)))
    solution = solve_pose(T, CAMERA, T, 1e-6 * np.eye(6), points)
    errors = np.zeros((2, 6, CALIBRATION))
    errors[1, :, 0] = xi
    equations, exact = equations_of(points, surfaces, T, keyframes, errors), equations_of(points, surfaces, T, keyframes)
    expected = np.linalg.solve(equations.H, (exact.C - equations.C)[:, 0])
    assert log_se3(invert(T) @ solution.T_world_camera) == pytest.approx(expected, rel=0.05, abs=0.02 * np.abs(expected).max())
    assert np.abs(expected - 0.5 * xi).max() > 0.2 * np.abs(xi).max()  # not their mean


def T_of_camera(xi):
    """The motion (4, 4) of the world for xi (6,) of the camera of `two_views`."""
    T = exp_se3(np.array([0.3, 0.05, 0.25, 0.05, 0.14, -0.03]))
    return T @ exp_se3(xi) @ invert(T)


def seen_from_origin(world, local, plane, count):
    """The first `count` of these points that the camera at the origin has in its image, too."""
    u, v = CAMERA.project(world).T
    seen = np.flatnonzero((world[:, 2] > 0.0) & (u >= 0.0) & (u < CAMERA.width) & (v >= 0.0) & (v < CAMERA.height))[:count]
    return world[seen], local[seen], plane


@pytest.mark.parametrize("parameter", range(CALIBRATION))
def test_a_pose_by_lines_errs_as_they_were_placed(parameter):
    """Lines alone, in the image and in depth, some on slanted surfaces: the pose errs by the sensitivity, and the image's residuals agree with the
    true error. Of the delay and the readout of depth, which moved no line of a keyframe at rest, they show nothing."""
    unit = 0.01 * np.eye(CALIBRATION)[parameter]
    rng, T = np.random.default_rng(6), exp_se3(np.array([0.3, 0.05, 0.25, 0.05, 0.14, -0.03]))
    theta, n = unit * calibration_scales(CAMERA), 60
    ends = [seen_from_origin(*points_on(rng, wall, T, 2 * n), n) for wall in WALLS]
    placed = np.concatenate([seen_from(*AT_REST[0], world, wall, theta) for (world, _, _), wall in zip(ends, WALLS)]).reshape(-1, 2, 3)
    pixels, depth = (np.concatenate(part) for part in zip(*(measured(local, plane, theta, TWIST)[:2] for _, local, plane in ends)))
    seen, small = CAMERA.back_project(pixels, depth).reshape(-1, 2, 3), np.tile(1e-5 * np.eye(3), (len(placed), 2, 1, 1))
    lines = LineTerms(placed, small, pixels.reshape(-1, 2, 2), np.ones(len(placed)), seen, small)
    none = PointTerms(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))
    solution = solve_pose(T, CAMERA, T, 1e-6 * np.eye(6), none, lines)
    assert (solution.lines > 0).all()
    flags = Flags(np.empty(0, np.uint8), solution.lines, np.empty(0, np.uint8))
    nothing = np.empty((0, 1), np.int32)
    surfaces = Surfaces(np.empty((0, 4)), np.repeat([plane for _, _, plane in ends], n, axis=0).reshape(-1, 2, 4))
    observers = Observers(nothing, np.zeros((len(placed), 1), np.int32), nothing)
    equations = calibration_equations(
        solution.T_world_camera, CAMERA.intrinsics, CAMERA.width, CAMERA.height, calibration_scales(CAMERA), TWIST, none, lines, NO_PLANES, flags,
        surfaces, np.empty((0, 8, 3), np.float32), observers, keyframes_of(AT_REST),
    )  # fmt: skip
    sensitivity, information, score = sensitivity_and_evidence(equations, np.zeros((6, 6)), NO_ERROR)
    error = log_se3(invert(T) @ solution.T_world_camera)
    expected = sensitivity @ unit
    assert error == pytest.approx(expected, rel=0.02, abs=0.01 * np.abs(expected).max())
    if parameter >= 10:
        assert abs(information[parameter, parameter]) < 1e-6
    else:
        assert score[parameter] / information[parameter, parameter] == pytest.approx(unit[parameter], rel=0.1)


def test_residuals_tell_of_the_calibration():
    """Two views with random errors of every parameter: the estimate from their residuals agrees with the truth by its covariance, and is nearer to it
    than nothing known."""
    true = 0.2 * np.random.default_rng(2).normal(0.0, 1.0, CALIBRATION)
    points, surfaces, T = two_views(true * calibration_scales(CAMERA))
    solution = solve_pose(T, CAMERA, T, 1e-6 * np.eye(6), points)
    assert (solution.points > 0).all()
    H, b, C, G, s, *_ = equations_of(points, surfaces, solution.T_world_camera)
    information, score = G - C.T @ np.linalg.solve(H, C), s - C.T @ np.linalg.solve(H, b)
    covariance = np.linalg.inv(information + np.eye(CALIBRATION))
    error = covariance @ score - true
    assert error @ np.linalg.solve(covariance, error) < CALIBRATION
    assert error @ error < 0.7 * (true @ true)
    assert np.trace(covariance) < 0.7 * CALIBRATION


def test_what_all_keyframes_err_in_common_tells_nothing_of_the_calibration():
    """Keyframes that err as the prior of the pose does: a drift of one degree for each parameter, which a prior of 0.1° would otherwise deny."""
    true = 0.2 * np.random.default_rng(2).normal(0.0, 1.0, CALIBRATION)
    points, surfaces, T = two_views(true * calibration_scales(CAMERA))
    T = solve_pose(T, CAMERA, T, 1e-6 * np.eye(6), points).T_world_camera
    prior, drift = np.diag([1e4] * 3 + [1.0 / np.radians(0.1) ** 2] * 3), np.radians(1.0) * np.random.default_rng(3).normal(size=(6, CALIBRATION))
    exact, carried = (equations_of(points, surfaces, T, errors=errors) for errors in (NO_ERROR, drift))
    sensitivity, information, score = sensitivity_and_evidence(exact, prior, NO_ERROR)
    with_drift = sensitivity_and_evidence(carried, prior, drift)
    assert with_drift[0] == pytest.approx(sensitivity + drift, rel=1e-9)
    assert with_drift[1] == pytest.approx(information, rel=1e-6, abs=1e-6 * np.abs(information).max())
    assert with_drift[2] == pytest.approx(score, rel=1e-6, abs=1e-6 * np.abs(score).max())


def test_of_a_plane_count_the_samples_that_both_views_show():
    """Samples far outside the keyframe's image, where an error with the square of the radius is large, change nothing; too few others are none."""
    T, keyframes = exp_se3(np.array([0.3, 0.05, 0.25, 0.05, 0.14, -0.03])), keyframes_of(AT_REST)
    wall = WALLS[1]
    local = np.append(T[:3, :3].T @ wall[:3], wall[3] + wall[:3] @ T[:3, 3])
    small = 1e-6 * np.eye(3)[None]
    planes = PlaneTerms(np.zeros(1, np.int32), wall[None], small, local[None], small)
    points = PointTerms(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))
    both = CAMERA.back_project(np.array([[u, v] for u in (340.0, 460.0, 600.0) for v in (100.0, 400.0)]), np.ones(6))
    beside = CAMERA.back_project(np.array([[u, 240.0] for u in (645.0, 650.0, 660.0)]), np.ones(3))  # in view of the camera alone
    both, beside = (rays * (-wall[3] / (rays @ wall[:3]))[:, None] for rays in (both, beside))

    def equations(samples):
        flags = Flags(np.empty(0, np.uint8), np.empty(0, np.uint8), np.ones(1, np.uint8))
        none = np.empty((0, 1), np.int32)
        observers = Observers(none, none, np.zeros((1, 1), np.int32))
        return calibration_equations(
            T, CAMERA.intrinsics, CAMERA.width, CAMERA.height, calibration_scales(CAMERA), TWIST, points, NO_LINES, planes, flags,
            Surfaces(np.empty((0, 4)), NO_ENDS), samples[None].astype(np.float32), observers, keyframes,
        )  # fmt: skip

    for sample in beside:
        pixel = CAMERA.project((invert(T) @ [*sample, 1.0])[None, :3])[0]
        assert 0.0 <= pixel[0] < CAMERA.width and 0.0 <= pixel[1] < CAMERA.height
    for a, b in zip(equations(both), equations(np.concatenate([both, beside]))):
        assert np.array_equal(a, b)
    assert equations(both).G.any() and not equations(np.concatenate([both[:3], beside])).G.any()


@pytest.mark.parametrize("parameter", range(CALIBRATION))
def test_points_of_a_plane_lie_where_a_camera_with_that_error_puts_them(parameter):
    """A camera, and two keyframes that observed the plane before it, have the same calibration error, and their poses err by it as well; a third one
    looked the other way, and so it alone knows nothing of the plane."""
    rng, T, scale = np.random.default_rng(2), exp_se3(np.array([0.3, 0.05, 0.25, 0.05, 0.14, -0.03])), calibration_scales(CAMERA)[parameter]
    theta = 1e-4 * scale * np.eye(CALIBRATION)[parameter]
    seen_by = keyframes_of((*MOVING, (np.diag([-1.0, 1.0, -1.0, 1.0]), TWIST)))
    seen_by, sensitivity = seen_by._replace(errors=rng.normal(0.0, 0.1, (3, 6, CALIBRATION))), rng.normal(0.0, 0.1, (6, CALIBRATION))
    world, local, plane = (part[:5] for part in points_on(rng, WALLS[1], T, 12))  # in view of both keyframes, too
    expected = measured(local, plane, theta, TWIST)[2] @ plane[:3] + plane[3]
    weights = np.array([CAMERA.depth_noise.sigma_m(((world - pose[:3, 3]) @ pose[:3, :3])[:, 2]) ** -2 for pose, _ in MOVING])
    weights /= weights.sum(axis=0)
    by_poses = np.broadcast_to(1e-4 * sensitivity[:, parameter], (5, 6)) - 1e-4 * weights.T @ seen_by.errors[:2, :, parameter]
    for weight, (pose, twist) in zip(weights, MOVING):
        then = np.append(pose[:3, :3].T @ WALLS[1][:3], WALLS[1][3] + WALLS[1][:3] @ pose[:3, 3])
        expected -= weight * (measured((world - pose[:3, 3]) @ pose[:3, :3], then, theta, twist)[2] @ then[:3] + then[3])
    expected += by_poses[:, :3] @ plane[:3] + (np.cross(local, plane[:3]) * by_poses[:, 3:]).sum(axis=1)
    moment = 1e-8 * np.outer(np.eye(CALIBRATION)[parameter], np.eye(CALIBRATION)[parameter])
    samples = np.append(local, [[np.nan] * 3, [0.0] * 3], axis=0)[None].astype(np.float32)
    for observers, known in (([0, 1, 2, -1], np.abs(expected)), ([2, -1, -1, -1], np.full(5, np.nan))):
        found = distance_sigmas(
            T, CAMERA.intrinsics, CAMERA.width, CAMERA.height, calibration_scales(CAMERA), TWIST, sensitivity, moment, WALLS[1:2], samples,
            np.array([observers], np.int32), seen_by,
        )  # fmt: skip
        assert found[0, :5] == pytest.approx(known, rel=1e-3, abs=1e-8, nan_ok=True) and np.isnan(found[0, 5:]).all()


def views_of(keyframes, errors):
    """Keyframes that err by the calibration (k, 6, 12), with their camera."""
    T, twists = (np.array(part) for part in zip(*keyframes))
    return Views(T, twists, errors, CAMERA.intrinsics, CAMERA.width, CAMERA.height, calibration_scales(CAMERA), CAMERA.depth_noise.coefficients)


@pytest.mark.parametrize("parameter", range(CALIBRATION))
def test_a_plane_turns_as_cameras_with_that_error_place_it(parameter):
    """Two keyframes with the same error of calibration, by which their poses err, too; the rotation is that in the frame of the second."""
    rng, scale, wall = np.random.default_rng(4), calibration_scales(CAMERA)[parameter], WALLS[1]
    theta, errors = 1e-3 * scale * np.eye(CALIBRATION)[parameter], rng.normal(0.0, 0.1, (2, 6, CALIBRATION))
    world = points_on(rng, wall, MOVING[1][0], 40)[0][:8]
    weights, placed = [], []
    for (T, twist), error in zip(MOVING, errors):
        local = (world - T[:3, 3]) @ T[:3, :3]
        then = np.append(T[:3, :3].T @ wall[:3], wall[3] + wall[:3] @ T[:3, 3])
        placed.append(transform(T @ exp_se3(1e-3 * error[:, parameter]), measured(local, then, theta, twist)[2]))
        weights.append(CAMERA.depth_noise.sigma_m(local[:, 2]) ** -2)
    along = sum(w * ((x - world) @ wall[:3]) for w, x in zip(weights, placed)) / sum(weights)
    R = MOVING[1][0][:3, :3]
    normal, local = R.T @ wall[:3], (world - MOVING[1][0][:3, 3]) @ R
    fitted = np.linalg.lstsq(np.c_[local, np.ones(8)] @ tangents(normal), along, rcond=None)[0]
    turned = np.cross(normal, -tangents(normal)[:3, :2] @ fitted[:2])
    found = plane_turns(
        wall[None], world[None].astype(np.float32), np.array([[0, 1, -1]], np.int32), np.array([1], np.int32), views_of(MOVING, errors)
    )
    assert 1e-3 * found[0, :, parameter] == pytest.approx(turned, rel=0.02, abs=0.01 * np.linalg.norm(turned) + 1e-9)


def tangents(normal):
    """Columns (4, 3) that take points (x, y, z, 1) to coordinates across a normal, and 1."""
    out = np.zeros((4, 3))
    out[:3, :2], out[3, 2] = np.linalg.svd(normal[None])[2][1:].T, 1.0
    return out


@pytest.mark.parametrize("parameter", range(CALIBRATION))
def test_a_line_turns_as_a_camera_with_that_error_places_it(parameter):
    """A slanted line on a wall that the camera looks straight at, of which it has a part in its image; its pose errs, too."""
    rng, scale, twist = np.random.default_rng(5), calibration_scales(CAMERA)[parameter], TWIST * [1.0, 1.0, 10.0, 1.0, 1.0, 1.0]
    theta, errors = 1e-3 * scale * np.eye(CALIBRATION)[parameter], rng.normal(0.0, 0.01, (1, 6, CALIBRATION))
    ends = np.array([[-0.4, -0.8, 3.0], [0.6, 1.0, 3.0]])
    pixels, depth, _ = measured(ends, WALLS[0], theta, twist)
    placed = transform(exp_se3(1e-3 * errors[0, :, parameter]), CAMERA.back_project(pixels, depth))
    d = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    turned = np.cross(d, (placed[1] - placed[0] - (ends[1] - ends[0])) / np.linalg.norm(ends[1] - ends[0]))
    first, none = np.zeros(1, np.int32), np.full((1, 2), -1, np.int32)
    views = views_of(((np.eye(4), twist),), errors)
    found = line_turns(ends[None], np.array([[0, -1]], np.int32), first, views)
    assert 1e-3 * found[0, :, parameter] == pytest.approx(turned, rel=0.02, abs=0.02 * np.linalg.norm(turned) + 1e-8)
    assert np.array_equal(line_turns(ends[None], none, first, views)[0], errors[0, 3:])
    beside = ends + np.array([9.0, 0.0, 0.0])  # not in its image
    assert np.array_equal(line_turns(beside[None], np.zeros((1, 1), np.int32), first, views)[0], errors[0, 3:])


def test_moments_of_the_calibration():
    """Nothing known: the unit variance of a camera of its kind. Known to be exact: nearly none. Known to be off: that, squared."""
    assert calibration_moment(np.zeros((CALIBRATION, CALIBRATION)), np.zeros(CALIBRATION)) == pytest.approx(np.eye(CALIBRATION))
    known = 1e4 * np.eye(CALIBRATION)
    assert np.abs(calibration_moment(known, np.zeros(CALIBRATION))).max() < 2e-4
    off = np.linspace(-2.0, 2.0, CALIBRATION)
    assert calibration_moment(known, known @ off) == pytest.approx(np.outer(off, off), abs=2e-3)


def test_parameters_that_no_residual_shows_keep_what_is_stated_of_them_at_least():
    """However right the others are; where these are off, they are as uncertain as these."""
    information = np.diag([1e4] * 6 + [0.0] * 6)
    right, wrong = (calibration_moment(information, information @ np.full(CALIBRATION, off)) for off in (0.0, 3.0))
    assert right[-1, -1] == pytest.approx(1.0) and wrong[-1, -1] > 2.0


def test_the_scale_of_depth_is_counted_with_the_way_from_the_first_camera():
    """3 m along the world's x, which the camera has turned into its z: 0.5 % are 15 mm of its z, and no rotation."""
    turned = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.pi / 2, 0.0]))
    turned[:3, 3] = 3.0, 0.0, 0.0
    pose = Pose(0, 0, turned, np.eye(6), np.eye(4), 0, np.zeros(3, np.int32), 0, "ok", "", depth_scale_sigma=0.005)
    assert calibration_covariance(pose) == pytest.approx(np.diag([0.0, 0.0, 0.015**2, 0.0, 0.0, 0.0]), abs=1e-12)
    assert carried_calibration(replace(pose, index=1, depth_scale_sigma=0.0), pose).depth_scale_sigma == 0.005


def test_a_pose_that_was_not_refined_keeps_the_error_of_the_previous_one():
    """A camera that moved 2 m: the position errs by the previous rotation's error besides."""
    sensitivity, moved = np.zeros((6, CALIBRATION)), np.eye(4)
    sensitivity[4, 3], moved[2, 3] = 0.01, 2.0
    first = Pose(0, 0, np.eye(4), np.eye(6), np.eye(4), 0, np.zeros(3, np.int32), 0, "ok", "", sensitivity=sensitivity)
    pose = carried_calibration(replace(first, T_world_camera=moved, index=1), first)
    assert pose.sensitivity[[0, 4], 3] == pytest.approx([0.02, 0.01])
    imprecise = np.repeat(0.2**2 * np.array([0.02, 0.01]) ** 2 / 3.0, 3)
    assert calibration_covariance(pose) == pytest.approx(pose.sensitivity @ pose.sensitivity.T + np.diag(imprecise))
    assert pose.sensitivity == pytest.approx(adjoint(invert(moved)) @ sensitivity)


@pytest.mark.parametrize(("theta", "said"), [(1.0, ""), (2.5, ""), (40.0, "the focal length fy is off by 40 times what is usual")])
def test_a_camera_that_is_not_the_stated_one_is_named(theta: float, said: str) -> None:
    """Residuals that know a parameter to a tenth of what is usual; 2.5 times what is usual is within what cameras without a prior may have."""
    information, score = np.zeros((CALIBRATION, CALIBRATION)), np.zeros(CALIBRATION)
    information[1, 1], score[1] = 100.0, 100.0 * theta
    stamps = 0, 0, np.eye(4), np.zeros((6, 6)), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", ""
    pose = replace(Pose(*stamps), calibration_information=information, calibration_score=score)
    assert contradicted_calibration(pose) == (said and f"the images contradict the camera's calibration: {said}")
