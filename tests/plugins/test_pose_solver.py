"""The pose solver against poses, noise and outliers that are known."""

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, pose_matrix, tangent_basis, transform, transform_planes
from trihedron.pipeline.core.lie import exp_se3, exp_so3, log_se3
from trihedron.pipeline.core.linalg_kernels import tangent_columns
from trihedron.pipeline.core.types import Camera
from trihedron.plugins.shared import pose_optimizer_kernels, residuals_kernels
from trihedron.plugins.shared.pose_optimizer import NO_LINES, NO_PLANES, NO_POINTS, classify_terms, first_step, solve_pose
from trihedron.plugins.shared.pose_optimizer_kernels import INLIER, NO_DEPTH, OUTLIER, Chi2, Flags
from trihedron.plugins.shared.residuals_kernels import PARALLEL, PERPENDICULAR, SAME, LineTerms, PlaneTerms, PointTerms, Weights

CAMERA = Camera(640, 480, 525.0, 520.0, 319.5, 239.5)
INTRINSICS = np.array([525.0, 520.0, 319.5, 239.5])
PRIOR_SIGMA = np.array([0.05, 0.05, 0.05, 0.03, 0.03, 0.03])


def covariances(rng, count, sigma):
    A = rng.normal(size=(count, 3, 3))
    return sigma**2 * (A @ np.swapaxes(A, 1, 2) / 3.0 + 0.3 * np.eye(3))


def shaken(rng, values, covariance):
    return values + (np.linalg.cholesky(covariance) @ rng.normal(size=(*values.shape, 1)))[..., 0]


def shaken_planes(rng, planes, covariance):
    delta = (np.linalg.cholesky(covariance) @ rng.normal(size=(len(planes), 3, 1)))[..., 0]
    normal = planes[:, :3] + (tangent_basis(planes[:, :3]) @ delta[:, :2, None])[..., 0]
    return np.concatenate([normal / np.linalg.norm(normal, axis=1, keepdims=True), planes[:, 3:] + delta[:, 2:]], axis=1)


class Scene:
    """Points, lines and planes before a camera at a random pose, measured with known noise; a share `outliers` is grossly wrong."""

    def __init__(self, rng, points=0, lines=0, kinds=(), outliers=0.0):
        self.T = pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3))
        self.bad_points, self.bad_lines = rng.random(points) < outliers, rng.random(lines) < outliers
        self.points, self.lines = self.make_points(rng, points), self.make_lines(rng, lines)
        self.planes = self.make_planes(rng, np.array(kinds, np.int32))

    def visible(self, rng, count):
        z = rng.uniform(1.0, 5.0, count)
        return CAMERA.back_project(rng.uniform([0, 0], [640, 480], (count, 2)), z)

    def make_points(self, rng, n):
        local, covariance = self.visible(rng, n), covariances(rng, n, 0.004)
        sigma_px, sigma_m = rng.choice([1.0, 1.2, 1.44], n), 0.003 * local[:, 2] ** 2
        pixels = CAMERA.project(local) + rng.normal(size=(n, 2)) * sigma_px[:, None]
        pixels[self.bad_points] += rng.choice([-1, 1], (self.bad_points.sum(), 2)) * rng.uniform(15, 60, (self.bad_points.sum(), 2))
        depth = np.where(rng.random(n) < 0.3, np.nan, local[:, 2] + rng.normal(size=n) * sigma_m)
        return PointTerms(shaken(rng, transform(self.T, local), covariance), covariance, pixels, depth, sigma_px, sigma_m)

    def make_lines(self, rng, m):
        local = self.visible(rng, 2 * m).reshape(m, 2, 3)
        covariance, seen_covariance = (covariances(rng, 2 * m, sigma).reshape(m, 2, 3, 3) for sigma in (0.004, 0.006))
        share = np.stack([rng.uniform(-0.1, 0.2, m), rng.uniform(0.8, 1.1, m)], axis=1)[..., None]
        seen = local[:, :1] + share * (local[:, 1:] - local[:, :1])  # another stretch of the same line
        pixels = CAMERA.project(seen) + rng.normal(size=(m, 2, 2))
        pixels[self.bad_lines] += rng.uniform(-60, 60, (self.bad_lines.sum(), 2, 2))
        seen = shaken(rng, seen, seen_covariance)
        seen[rng.random(m) < 0.3] = np.nan
        return LineTerms(shaken(rng, transform(self.T, local), covariance), covariance, pixels, np.ones(m), seen, seen_covariance)

    def make_planes(self, rng, kinds):
        p = len(kinds)
        normal = rng.normal(size=(p, 3))
        world = np.concatenate([normal / np.linalg.norm(normal, axis=1, keepdims=True), rng.normal(size=(p, 1)) * 2.0], axis=1)
        seen = transform_planes(invert(self.T), world)
        for i in range(p):
            if kinds[i] == PARALLEL:
                seen[i] = [*seen[i, :3] * rng.choice([-1, 1]), rng.uniform(0, 3)]
            if kinds[i] == PERPENDICULAR:
                across = np.cross(seen[i, :3], rng.normal(size=3))
                seen[i, :3] = across / np.linalg.norm(across)
        covariance, seen_covariance = covariances(rng, p, 0.004), covariances(rng, p, 0.003)
        return PlaneTerms(kinds, shaken_planes(rng, world, covariance), covariance, shaken_planes(rng, seen, seen_covariance), seen_covariance)

    def solve(self, rng, fixed_rotation=False):
        """From a start drawn from the prior. Returns the error xi, its normalised square and the solution."""
        off = rng.normal(size=6) * PRIOR_SIGMA * ([1, 1, 1, 0, 0, 0] if fixed_rotation else 1.0)
        start = self.T @ exp_se3(off)
        found = solve_pose(start, CAMERA, start, np.diag(PRIOR_SIGMA**-2), self.points, self.lines, self.planes, fixed_rotation)
        xi = log_se3(invert(found.T_world_camera) @ self.T)[: len(found.covariance)]
        return xi, float(xi @ np.linalg.solve(found.covariance, xi)), found


ALL_SAME = (SAME,) * 10
RELATED = (SAME, SAME, *(PARALLEL,) * 4, *(PERPENDICULAR,) * 4)


@pytest.mark.parametrize(
    "contents",
    [{"points": 100}, {"lines": 50}, {"kinds": ALL_SAME}, {"kinds": RELATED}, {"kinds": (SAME,)}, {"points": 80, "lines": 25, "kinds": ALL_SAME[:6]}],
    ids=["points", "lines", "planes", "relations", "one plane", "all"],
)
def test_the_covariance_is_honest(contents):
    """Normalised error squared of a 6-vector: mean 6, and within 95 % of that for 200 trials (2 · 6 / 200 is its variance)."""
    rng = np.random.default_rng(7)
    errors = [Scene(rng, **contents).solve(rng)[1] for _ in range(200)]
    assert abs(np.mean(errors) - 6.0) < 1.96 * np.sqrt(12.0 / 200.0)


def test_the_covariance_of_a_position_is_honest():
    rng = np.random.default_rng(8)
    errors = [Scene(rng, 60, 20, ALL_SAME[:5]).solve(rng, fixed_rotation=True)[1] for _ in range(200)]
    assert abs(np.mean(errors) - 3.0) < 1.96 * np.sqrt(6.0 / 200.0)


@pytest.mark.parametrize(
    "contents", [{"points": 150}, {"lines": 60}, {"points": 100, "lines": 40, "kinds": ALL_SAME}], ids=["points", "lines", "all"]
)
def test_a_third_of_outliers_is_found_and_costs_nothing(contents):
    """The error is that of the same scene with the outliers taken out by hand."""
    disturbed, clean, missed, gross = [], [], 0, 0
    for seed in range(40):
        scene = Scene(np.random.default_rng(seed), **contents, outliers=0.3)
        xi, _, found = scene.solve(np.random.default_rng(1000 + seed))
        disturbed.append(xi)
        missed += found.points[scene.bad_points].sum() + (found.lines[scene.bad_lines] > 0).sum()
        gross += scene.bad_points.sum() + scene.bad_lines.sum()
        scene.points = PointTerms(*(column[~scene.bad_points] for column in scene.points))
        scene.lines = LineTerms(*(column[~scene.bad_lines] for column in scene.lines))
        clean.append(scene.solve(np.random.default_rng(1000 + seed))[0])
    assert missed < 0.05 * gross
    assert np.sqrt(np.mean(np.square(disturbed))) < 1.1 * np.sqrt(np.mean(np.square(clean)))


def numeric(function, T):
    """Central differences of function(T · Exp(xi)) at xi = 0, (rows, 6)."""
    h = 1e-6
    steps = [(function(T @ exp_se3(h * e)) - function(T @ exp_se3(-h * e))) / (2 * h) for e in np.eye(6)]
    return np.stack(steps, axis=-1)


def random_pose(rng):
    return pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3))


def local_of(T, world):
    out = np.empty(3)
    residuals_kernels.to_camera(np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), world, out)
    return out


def test_jacobian_of_a_point():
    rng = np.random.default_rng(1)
    for depth in (2.0, np.nan):
        T = random_pose(rng)
        world = transform(T, np.array([0.3, -0.4, 2.2]))
        D, J, r = np.empty((3, 3)), np.empty((3, 6)), np.empty(3)

        def residual(T, world=world, depth=depth):
            r, D = np.empty(3), np.empty((3, 3))
            assert residuals_kernels.point_residual(local_of(T, world), np.array([300.0, 200.0]), depth, INTRINSICS, r, D)
            return r

        residuals_kernels.point_residual(local_of(T, world), np.array([300.0, 200.0]), depth, INTRINSICS, r, D)
        residuals_kernels.pose_jacobian(D, 3, local_of(T, world), J)
        assert np.allclose(J, numeric(residual, T), rtol=1e-6, atol=1e-5)
        assert np.isfinite(depth) == (abs(J[2]).max() > 0)


def test_jacobian_of_a_line_in_the_image_and_in_depth():
    rng = np.random.default_rng(2)
    T = random_pose(rng)
    world = transform(T, np.array([0.3, -0.4, 2.2]))
    segment_px, segment_m = np.array([[100.0, 50.0], [400.0, 330.0]]), np.array([[-0.5, 0.2, 2.0], [0.6, 0.3, 2.6]])
    m, D, J = np.empty(3), np.empty((1, 3)), np.empty((1, 6))
    assert residuals_kernels.depth_direction(segment_m, m)
    assert abs(m @ (segment_m[1] - segment_m[0])) < 1e-12 and abs(m @ np.cross(*segment_m)) < 1e-12
    residuals_kernels.line_residual(local_of(T, world), segment_px, INTRINSICS, D[0])
    residuals_kernels.pose_jacobian(D, 1, local_of(T, world), J)
    image = numeric(lambda T: np.array([residuals_kernels.line_residual(local_of(T, world), segment_px, INTRINSICS, np.empty(3))[0]]), T)
    assert np.allclose(J, image, rtol=1e-6, atol=1e-5)
    residuals_kernels.pose_jacobian(m[None].copy(), 1, local_of(T, world), J)
    depth = numeric(lambda T: np.array([residuals_kernels.line_depth_residual(local_of(T, world), segment_m, m)[0]]), T)
    assert np.allclose(J, depth, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("kind, rows", [(SAME, 3), (PARALLEL, 2), (PERPENDICULAR, 1)])
def test_jacobian_of_planes_at_every_normal(kind, rows):
    """Among them n = ±z, where azimuth and elevation are singular."""
    rng = np.random.default_rng(3)
    for normal in ([0, 0, -1.0], [0, 0, 1.0], [1.0, 0, 0], *rng.normal(size=(10, 3))):
        T = random_pose(rng)
        observed = np.array([*np.asarray(normal) / np.linalg.norm(normal), 1.7])
        close = shaken_planes(rng, observed[None], np.diag([0.01, 0.01, 0.01])[None] ** 2)[0]
        world = transform_planes(T, close[None])[0] * (-1.0 if kind == PARALLEL else 1.0)  # the opposite wall
        B = tangent_basis(observed[:3])

        def residual(T, world=world, observed=observed, B=B):
            r, J = np.empty(3), np.empty((3, 6))
            R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
            assert residuals_kernels.plane_residual(kind, R, t, world, observed, B, r, J) == rows
            return r[:rows].copy()

        J = np.empty((3, 6))
        residuals_kernels.plane_residual(kind, T[:3, :3].copy(), T[:3, 3].copy(), world, observed, B, np.empty(3), J)
        assert np.allclose(J[:rows], numeric(residual, T), atol=1e-7)
        assert kind == PERPENDICULAR or np.abs(residual(T)[:2]).max() < 0.05


def test_the_basis_is_that_of_the_geometry_module():
    for n in np.random.default_rng(4).normal(size=(20, 3)):
        B = np.empty((3, 2))
        tangent_columns(n / np.linalg.norm(n), B)
        assert np.allclose(B, tangent_basis(n / np.linalg.norm(n)), atol=1e-15)


def test_without_terms_the_prior_stands():
    T = random_pose(np.random.default_rng(5))
    found = solve_pose(T @ exp_se3(np.full(6, 0.01)), CAMERA, T, np.diag(PRIOR_SIGMA**-2))
    assert np.allclose(found.T_world_camera, T, atol=1e-9)
    assert np.allclose(found.covariance, np.diag(PRIOR_SIGMA**2))
    assert found.unobservable.shape == (6, 6)


def test_one_plane_moves_only_what_it_sees():
    """A wall ahead: its distance and two rotations; sideways, up and the turn about its normal stay at the prediction, and are said to."""
    T = np.eye(4)
    wall = np.array([[0.0, 0.0, -1.0, 2.0]])
    tight = np.diag([1e-3, 1e-3, 1e-3])[None] ** 2
    found = solve_pose(T, CAMERA, T, np.diag(PRIOR_SIGMA**-2), planes=PlaneTerms(np.zeros(1, np.int32), wall, tight, wall - [0, 0, 0, 0.03], tight))
    assert np.allclose(found.T_world_camera[:3, 3], [0, 0, 0.03], atol=1e-4)
    assert found.unobservable.shape == (6, 3)
    held = np.abs(np.linalg.qr(found.unobservable)[0]) ** 2
    assert np.allclose(held.sum(axis=1), [1, 1, 0, 0, 0, 1], atol=1e-3)


@pytest.mark.parametrize("tilt, disputed", [(0.0, 0), (0.011, 1)])
def test_a_wall_that_disagrees_and_alone_observes_a_direction(tilt, disputed):
    """Three walls at right angles, known and measured to a milliradian; one is measured at another angle to the others. Without it the position along
    its normal is that of the prior."""
    walls, tight = np.concatenate([np.eye(3), np.full((3, 1), 2.0)], axis=1), np.tile(1e-6 * np.eye(3), (3, 1, 1))
    seen = walls.copy()
    seen[2, :3] = exp_so3(np.array([tilt, 0.0, 0.0])) @ seen[2, :3]
    found = solve_pose(
        np.eye(4), CAMERA, np.eye(4), np.diag(PRIOR_SIGMA**-2), planes=PlaneTerms(np.full(3, SAME, np.int32), walls, tight, seen, tight)
    )
    assert found.planes.all() and not found.unobservable.shape[1] and found.disputed == disputed


def test_planes_with_the_rotation_known_are_a_linear_problem():
    """`n·t = d_camera - d_world`: the closed form of weighted least squares, prior included."""
    rng = np.random.default_rng(6)
    T = random_pose(rng)
    world = shaken_planes(rng, np.concatenate([np.eye(3), np.zeros((3, 1))], axis=1)[[0, 1, 2, 0]], covariances(rng, 4, 0.1))
    observed = transform_planes(invert(T), world)
    observed[:, 3] += rng.normal(size=4) * 0.01
    flat = np.tile(np.diag([1e-12, 1e-12, 1e-4]), (4, 1, 1))
    start = T.copy()
    start[:3, 3] += 0.02
    prior = np.diag([100.0, 100.0, 100.0, 1.0, 1.0, 1.0])
    kinds = np.zeros(4, np.int32)
    found = solve_pose(start, CAMERA, start, prior, planes=PlaneTerms(kinds, world, 0.5 * flat, observed, 0.5 * flat), fixed_rotation=True)
    n, b = world[:, :3], observed[:, 3] - world[:, 3]
    H = 1e4 * n.T @ n + 100.0 * np.eye(3)
    expected = np.linalg.solve(H, 1e4 * n.T @ b + 100.0 * start[:3, 3])
    assert found.planes.all()
    assert np.allclose(found.T_world_camera[:3, 3], expected, atol=1e-6)
    assert np.array_equal(found.T_world_camera[:3, :3], start[:3, :3])


def test_bad_input_harms_nothing():
    """Points behind the camera, NaN and a line that points at the camera: no exception, no NaN, and the rest is solved."""
    rng = np.random.default_rng(10)
    scene = Scene(rng, 60, 20, ALL_SAME[:4])
    scene.points.positions_m[0] = transform(scene.T, np.array([0.0, 0.0, -1.0]))
    scene.points.positions_m[1] = np.nan
    scene.points.pixels[2] = np.nan
    scene.lines.endpoints_m[0, 0] = scene.T[:3, 3]
    scene.lines.observed_m[1] = [[0, 0, 1.0], [0, 0, 2.0]]
    scene.lines.endpoints_px[2, 1] = scene.lines.endpoints_px[2, 0]
    _, chi2, found = scene.solve(rng)
    assert np.isfinite(found.T_world_camera).all() and np.isfinite(found.covariance).all()
    assert not found.points[:3].any() and not found.lines[0]
    assert chi2 < 25.0


def test_the_same_input_gives_the_same_bytes():
    scene = Scene(np.random.default_rng(11), 100, 30, RELATED)
    results = [scene.solve(np.random.default_rng(0))[2] for _ in range(2)]
    assert results[0].T_world_camera.tobytes() == results[1].T_world_camera.tobytes()
    assert results[0].covariance.tobytes() == results[1].covariance.tobytes()


def test_terms_are_judged_at_a_pose():
    rng = np.random.default_rng(12)
    scene = Scene(rng, 200, 50, ALL_SAME, outliers=0.3)
    flags = classify_terms(scene.T, CAMERA, scene.points, scene.lines, scene.planes)
    assert not flags.points[scene.bad_points].any()
    assert flags.points[~scene.bad_points].mean() > 0.9 and (flags.lines[~scene.bad_lines] > 0).mean() > 0.85
    assert all(len(part) == 0 for part in classify_terms(scene.T, CAMERA, NO_POINTS, NO_LINES, NO_PLANES))


def test_the_first_step_goes_where_the_solution_is():
    """From 4 mm and 0.1 degrees beside it; that is off by less than a fifth, and about as uncertain."""
    scene = Scene(np.random.default_rng(13), 200, 50, ALL_SAME)
    prior = np.diag(PRIOR_SIGMA**-2)
    found = solve_pose(scene.T, CAMERA, scene.T, prior, scene.points, scene.lines, scene.planes)
    off = np.array([0.003, -0.002, 0.002, 0.001, 0.001, -0.001])
    xi, covariance = first_step(found.T_world_camera @ exp_se3(off), CAMERA, scene.T, prior, (scene.points, scene.lines, scene.planes))
    assert np.linalg.norm(xi + off) < 0.2 * np.linalg.norm(off)
    assert np.allclose(np.diag(covariance) / np.diag(found.covariance), 1.0, atol=0.3)


@pytest.mark.parametrize("with_depth", [False, True])
def test_one_point_in_twenty_is_beyond_its_gate(with_depth):
    """At the true pose: a pixel has two degrees of freedom, and three with a depth."""
    scene = Scene(np.random.default_rng(14), 6000)
    chosen = np.isfinite(scene.points.depth_m) == with_depth
    flags = classify_terms(scene.T, CAMERA, PointTerms(*(column[chosen] for column in scene.points)))
    assert 1.0 - flags.points.mean() == pytest.approx(0.05, abs=0.01)


def test_residuals_are_counted():
    """Those of inliers: pixel and depth of a point, two distances of a line in the image and two in depth, and three, two or one of planes."""
    scene = Scene(np.random.default_rng(15), 4, 4, (SAME, PARALLEL, PERPENDICULAR, SAME))
    points = scene.points._replace(depth_m=np.array([1.0, np.nan, 2.0, np.nan]))
    lines, planes = np.array([INLIER, NO_DEPTH, OUTLIER, INLIER], np.uint8), np.array([INLIER, INLIER, INLIER, OUTLIER], np.uint8)
    flags = Flags(np.array([INLIER, INLIER, OUTLIER, INLIER], np.uint8), lines, planes)
    assert pose_optimizer_kernels._residual_count(points, scene.planes, flags) == (3 + 2 + 2) + (4 + 2 + 4) + (3 + 2 + 1)


def linearised(points, lines, robust):
    """Cost and gradient by xi of terms at the identity, all of them inliers, with their information there."""
    n, m = len(points.positions_m), len(lines.endpoints_m)
    weights = Weights(np.empty((n, 3, 3)), np.empty((m, 2, 2)), np.empty((m, 2, 2)), np.empty((0, 3, 3)))
    pose, H, g = (np.eye(3), np.zeros(3), INTRINSICS), np.empty((6, 6)), np.empty(6)
    residuals_kernels.fill_weights(*pose, points, lines, NO_PLANES, weights)
    flags = Flags(np.full(n, INLIER, np.uint8), np.full(m, INLIER, np.uint8), np.empty(0, np.uint8))
    chi2 = Chi2(np.empty(n), np.empty(m), np.empty(m), np.empty(0))
    cost = pose_optimizer_kernels.linearise(*pose, points, lines, NO_PLANES, weights, flags, robust, 6, H, g, chi2)
    return cost, 2.0 * g, weights


@pytest.mark.parametrize(("kind", "limit"), [("pixel", 5.991), ("pixel and depth", 7.815), ("line", 5.991)])
def test_the_cost_is_hubers(kind, limit):
    """χ² up to the gate and linear in the residual from there on, without a step; the gradient is the derivative."""

    def cost_of(sigmas, robust=True):
        points, lines = NO_POINTS, NO_LINES
        if kind == "line":  # horizontal, and seen in the image alone
            ends, pixels = np.array([[[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]]]), np.array([[[188.25, 239.5], [450.75, 239.5]]])
            none = np.full((1, 2, 3), np.nan)
            lines = LineTerms(ends, np.zeros((1, 2, 3, 3)), pixels + np.array([0.0, sigmas / np.sqrt(2.0)]), np.ones(1), none, np.zeros((1, 2, 3, 3)))
        else:
            depth = np.array([2.0 if kind == "pixel and depth" else np.nan])
            pixel = np.array([[319.5, 239.5 + sigmas]])
            points = PointTerms(np.array([[0.0, 0.0, 2.0]]), np.zeros((1, 3, 3)), pixel, depth, np.ones(1), np.full(1, 0.01))
        return linearised(points, lines, robust)

    per_m, gate = 520.0 / 2.0 * (np.sqrt(2.0) if kind == "line" else 1.0), np.sqrt(limit)
    for sigmas in (0.5, 2.0, gate - 1e-6, gate + 1e-6, 3.0, 5.0, 20.0):
        cost, gradient, _ = cost_of(sigmas)
        assert cost == pytest.approx(sigmas**2 if sigmas < gate else 2.0 * gate * sigmas - limit, rel=1e-9)
        assert gradient[1] == pytest.approx(2.0 * min(sigmas, gate) * per_m, rel=1e-6)  # of the camera's way down, by which the residual grows
        assert cost_of(sigmas, robust=False)[0] == pytest.approx(sigmas**2)


def test_the_ends_of_a_line_seen_in_part_err_together():
    """A fifth of a line is seen: extrapolated to both ends of the map's line the noise of its ends is five times as large, and has opposite signs."""
    rng, map_m = np.random.default_rng(16), np.array([[-1.0, 0.2, 3.0], [1.2, -0.3, 3.5]])
    seen_m = map_m[0] + np.array([[0.4], [0.6]]) * (map_m[1] - map_m[0])
    seen_px, none, noise = CAMERA.project(seen_m), np.zeros((1, 2, 3, 3)), np.tile(np.eye(3) * 0.003**2, (1, 2, 1, 1))
    _, _, weights = linearised(NO_POINTS, LineTerms(map_m[None], none, seen_px[None], np.array([0.3]), seen_m[None], noise), False)
    image, depth, D, m = [], [], np.empty(3), np.empty(3)
    for _ in range(3000):
        shaken_px, shaken_m = seen_px + 0.3 * rng.normal(size=(2, 2)), seen_m + 0.003 * rng.normal(size=(2, 3))
        assert residuals_kernels.depth_direction(shaken_m, m)
        image.append([residuals_kernels.line_residual(p, shaken_px, INTRINSICS, D)[0] for p in map_m])
        depth.append([residuals_kernels.line_depth_residual(p, shaken_m, m)[0] for p in map_m])
    for residuals, information in ((image, weights.lines[0]), (depth, weights.line_depths[0])):
        stated = np.linalg.inv(information)
        assert np.allclose(np.cov(np.transpose(residuals)), stated, rtol=0.1) and stated[0, 1] < -0.8 * stated[0, 0]


def test_relations_say_nothing_of_how_far_away_walls_are():
    """Walls whose distances are known by nothing: a pose by their angles is the same, bit for bit."""
    rng = np.random.default_rng(17)
    scene = Scene(rng, 20, kinds=(PARALLEL,) * 4 + (PERPENDICULAR,) * 4)
    known = scene.solve(np.random.default_rng(0))[2]
    for covariance in (scene.planes.covariance, scene.planes.observed_covariance):
        covariance[:, 2, :], covariance[:, :, 2] = 0.0, 0.0
        covariance[:, 2, 2] = np.inf
    unknown = scene.solve(np.random.default_rng(0))[2]
    assert known.planes.all() and unknown.planes.all()
    assert np.array_equal(known.T_world_camera, unknown.T_world_camera) and np.array_equal(known.covariance, unknown.covariance)
