"""Planar regions of scenes whose planes are known."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.plugins.none import NoPlanes
from trihedron.plugins.normals.integral_image import IntegralImage
from trihedron.plugins.planes.ahc import Ahc
from trihedron.plugins.planes.cape import Cape
from trihedron.plugins.planes.connected_components import ConnectedComponents
from trihedron.plugins.planes.ransac import Ransac
from trihedron.plugins.planes.region_cells_kernels import gather_cells
from trihedron.plugins.planes.trimmed_fit_kernels import fit_cells
from trihedron.plugins.shared.depth_image_kernels import Grid

CORNER = (((0.6, 0.0, -0.8), 2.2), ((-0.6, 0.0, -0.8), 2.2), ((0.0, -0.96, -0.28), 1.2))  # two walls and the floor


def unit(normal):
    return np.asarray(normal, float) / np.linalg.norm(normal)


@pytest.fixture(params=[ConnectedComponents, Ahc, Cape, Ransac], ids=lambda plugin: plugin.__name__)
def plugin(request):
    return request.param


def detect(plugin, frame, **fields):
    rng = {"rng": np.random.default_rng(5)} if plugin is Ransac else {}
    return plugin(**fields)(frame, IntegralImage()(frame), **rng)


def closest(planes, normal):
    """Row of the plane nearest in direction, the angle in degrees, and its d."""
    cosines = planes.coefficients[:, :3] @ unit(normal)
    row = int(np.argmax(cosines))
    return row, np.degrees(np.arccos(min(cosines[row], 1.0))), planes.coefficients[row, 3]


def corner(analytic):
    depths = [analytic.plane(n, d) for n, d in CORNER]
    return np.where(np.stack(depths) > 0.0, np.stack(depths), np.inf)


@pytest.mark.parametrize(("normal", "d"), [((0, 0, -1), 1.0), ((0.3, -0.4, -1), 2.0), ((-1, 0.1, -0.8), 0.9)])
def test_one_tilted_plane(plugin, analytic, normal, d):
    depth = analytic.plane(normal, d)
    depth[depth > 5.0] = 0.0
    planes = detect(plugin, analytic.frame(depth))
    assert len(planes.coefficients) == 1 and planes.stride == 2 and planes.labels.shape == (240, 320)
    _, angle, found = closest(planes, normal)
    assert angle < 0.02 and abs(found - d) < 0.001 and abs(np.linalg.norm(planes.coefficients[0, :3]) - 1.0) < 1e-12
    assert planes.pixels[0] > 0.98 * (depth > 0.0).sum()
    samples = planes.samples_m[0].astype(float)
    assert np.abs(samples @ unit(normal) + d).max() < 0.002
    values, vectors = np.linalg.eigh(planes.moments[0])
    implied = vectors[:, 0] / np.linalg.norm(vectors[:3, 0]) * np.sign(vectors[3, 0])
    assert np.abs(implied - [*unit(normal), d]).max() < 0.002 and values[0] >= -1e-6 * values[-1]


def test_corner_gives_three_planes_with_clean_borders(plugin, analytic):
    depths = corner(analytic)
    planes = detect(plugin, analytic.frame(depths.min(0)))
    assert len(planes.coefficients) == 3 and (np.diff(planes.pixels) <= 0).all() and planes.coefficients[:, 3].min() >= 0.0
    owner = depths.argmin(0)[::2, ::2]
    for i, (normal, d) in enumerate(CORNER):
        row, angle, found = closest(planes, normal)
        assert angle < 0.05 and abs(found - d) < 0.002
        assert (planes.labels[owner == i] == row + 1).mean() > 0.97


def test_corner_seen_by_a_noisy_sensor(plugin, analytic):
    depths = corner(analytic)
    planes = detect(plugin, analytic.frame(analytic.noisy(depths.min(0)), analytic.sensor))
    assert len(planes.coefficients) == 3
    owner = depths.argmin(0)[::2, ::2]
    for i, (normal, d) in enumerate(CORNER):
        row, angle, found = closest(planes, normal)
        assert angle < 0.3 and abs(found - d) < 0.008
        assert (planes.labels[owner == i] == row + 1).mean() > 0.9


@pytest.mark.parametrize("noise", [False, True])
def test_small_step_stays_two_planes(plugin, analytic, noise):
    depth = np.full((480, 640), 1.5)
    depth[:, 330:] = 1.53
    camera = analytic.sensor if noise else analytic.exact
    planes = detect(plugin, analytic.frame(analytic.noisy(depth, camera) if noise else depth, camera))
    assert sorted(np.round(planes.coefficients[:, 3], 2)) == [1.5, 1.53]
    assert np.abs(np.sort(planes.coefficients[:, 3]) - [1.5, 1.53]).max() < 0.002


@pytest.mark.parametrize("seed", range(3))
def test_a_board_on_a_wall_within_the_noise_leans_neither(plugin, analytic, seed):
    """4 cm are 3 σ at this distance: one plane through both would be 2° off."""
    normal = unit((0.25, -0.3, -1))
    wall, board = analytic.plane(normal, 2.1), analytic.plane(normal, 2.06)
    depth = wall.copy()
    depth[:, 300:] = board[:, 300:]
    planes = detect(plugin, analytic.frame(analytic.noisy(depth, analytic.sensor, seed), analytic.sensor))
    large = planes.coefficients[planes.pixels > 50000]
    angles = np.degrees(np.arccos(np.minimum(large[:, :3] @ normal, 1.0)))
    assert len(large) == 2 and angles.max() < 0.3 and np.abs(np.sort(large[:, 3]) - [2.06, 2.1]).max() < 0.008


@pytest.mark.parametrize(("radius", "distance", "noise"), [(0.15, 1.2, False), (0.3, 1.5, False), (0.3, 1.5, True), (0.6, 2.0, True)])
def test_cylinder_is_not_a_plane(plugin, analytic, radius, distance, noise):
    camera = analytic.sensor if noise else analytic.exact
    depth = analytic.cylinder(0.0, distance, radius)
    on_cylinder = (depth > 0.0)[::2, ::2]
    planes = detect(plugin, analytic.frame(analytic.noisy(depth, camera) if noise else depth, camera))
    assert (planes.labels[on_cylinder] > 0).mean() < 0.05


def test_a_strip_of_missing_depth_does_not_part_a_wall(plugin, analytic):
    depth = analytic.plane((0.2, 0.0, -1), 2.0)
    depth[:, 300:306] = 0.0
    planes = detect(plugin, analytic.frame(depth))
    assert len(planes.coefficients) == 1 and planes.pixels[0] > 0.95 * (depth > 0.0).sum()


def test_gentle_fold_is_two_planes(plugin, analytic):
    normals = ((0.13, 0.0, -1.0), (-0.13, 0.0, -1.0))  # 15 degrees apart
    planes = detect(plugin, analytic.frame(np.maximum(analytic.plane(normals[0], 2.0), analytic.plane(normals[1], 2.0))))
    assert len(planes.coefficients) == 2
    assert max(closest(planes, n)[1] for n in normals) < 0.1


def test_near_points_count_more(plugin, analytic):
    """A floor under the sensor's noise: the fit must be that of weighted, not plain, least squares."""
    normal = unit((0.0, -0.94, -0.34))
    depth = analytic.plane(normal, 1.2)
    depth[depth > 4.5] = 0.0
    errors = []
    for seed in range(5):
        planes = detect(plugin, analytic.frame(analytic.noisy(depth, analytic.sensor, seed), analytic.sensor))
        _, angle, d = closest(planes, normal)
        errors.append((angle, abs(d - 1.2)))
    assert np.mean(errors, axis=0)[0] < 0.05 and np.mean(errors, axis=0)[1] < 0.001


def normalised_errors(plugin, analytic, draw, seeds, **fields):
    """χ² / 3 of (a, b, d) of a wall over draws of the noise."""
    normal, d = unit((0.3, -0.2, -1)), 1.8
    depth = analytic.plane(normal, d)
    basis, found = tangent_basis(normal), []
    for seed in range(seeds):
        planes = detect(plugin, analytic.frame(draw(depth, seed), analytic.sensor), **fields)
        n = planes.coefficients[0, :3]
        error = np.array([*(basis.T @ n) / (n @ normal), planes.coefficients[0, 3] - d])
        found.append(error @ np.linalg.solve(planes.covariance[0], error) / 3.0)
    return np.array(found)


def test_covariance_follows_correlated_noise(plugin, analytic):
    """Noise in blobs of 12 px is many times worse for a plane than independent noise; the covariance must know without being told."""

    def draw(depth, seed):
        coarse = np.random.default_rng(seed).standard_normal((40, 54))
        return depth + np.kron(coarse, np.ones((12, 12)))[:480, :640] * 0.6 * analytic.sensor.depth_noise.sigma_m(depth)

    assert 0.4 < normalised_errors(plugin, analytic, draw, 12, bias=0.0).mean() < 2.0


def test_covariance_is_not_too_small_for_independent_noise(plugin, analytic):
    chi2 = normalised_errors(plugin, analytic, lambda depth, seed: analytic.noisy(depth, analytic.sensor, seed), 5)
    assert chi2.max() < 1.0  # the systematic share keeps it from vanishing


def test_covariance_is_positive_and_small_planes_are_less_certain(plugin, analytic):
    depth = np.full((480, 640), 1.5)
    depth[200:260, 300:360] = 1.0
    planes = detect(plugin, analytic.frame(analytic.noisy(depth), analytic.sensor))
    assert len(planes.pixels) == 2 and planes.pixels[1] < 4000
    eigenvalues = np.linalg.eigvalsh(planes.covariance)
    assert eigenvalues.min() > 0.0 and planes.covariance[1, 0, 0] > 4.0 * planes.covariance[0, 0, 0]


def test_samples_spread_over_the_region(plugin, analytic):
    planes = detect(plugin, analytic.frame(analytic.plane((0, 0, -1), 2.0)))
    pixels = analytic.exact.project(planes.samples_m[0].astype(float))
    cells, _, _ = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=[4, 3], range=[[0, 640], [0, 480]])
    assert planes.samples_m.shape == (1, 48, 3) and cells.min() >= 1 and cells.max() <= 8


def test_smallest_and_most(plugin, analytic):
    depth = np.zeros((480, 640))
    for k in range(6):
        depth[20:80, 100 * k : 100 * k + 60 + 4 * k] = 1.0 + 0.3 * k
    assert len(detect(plugin, analytic.frame(depth)).pixels) == 6
    planes = detect(plugin, analytic.frame(depth), planes=3)
    assert len(planes.pixels) == 3 and planes.labels.max() == 3 and np.round(planes.coefficients[0, 3], 2) == 2.5
    assert len(detect(plugin, analytic.frame(depth), min_pixels=6000).pixels) == 0


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_nothing_measured_gives_no_planes(plugin, analytic, value):
    planes = detect(plugin, analytic.frame(np.full((480, 640), value)))
    assert planes.coefficients.shape == (0, 4) and planes.samples_m.shape == (0, 48, 3) and not planes.labels.any()


def test_pure_noise_does_not_raise(plugin, analytic):
    depth = np.random.default_rng(0).uniform(0.0, 5.0, (480, 640))
    assert len(detect(plugin, analytic.frame(depth)).pixels) <= 24


def test_cells_in_one_line_are_no_plane():
    """Their fit is singular, and nothing is left marked as a member of it."""
    w = 60
    normals = np.tile(np.array([0, 0, -1], np.float32), (1, w, 1))
    rho, sigma, count = np.full((1, w), 0.5, np.float32), np.full((1, w), 0.01, np.float32), np.ones((1, w), np.int32)
    member = np.zeros(w, np.bool_)
    grid = Grid(rho, sigma, count, np.linspace(-1.0, 1.0, w), np.zeros(1), normals)
    q, members = fit_cells(np.array([0.0, 0.0, 0.5]), gather_cells(grid, np.arange(w, dtype=np.int32)), 0.98, 3.0, member)
    assert members == 0 and not member.any() and not q.any()


def test_same_bytes_from_any_thread(plugin, analytic):
    frame = analytic.frame(analytic.noisy(corner(analytic).min(0)), analytic.sensor)
    alone = detect(plugin, frame)
    with ThreadPoolExecutor(2) as pool:
        for planes in pool.map(partial(detect, plugin), [frame] * 4):
            for name in ("coefficients", "covariance", "moments", "pixels", "samples_m", "labels"):
                assert getattr(planes, name).tobytes() == getattr(alone, name).tobytes()


@pytest.mark.parametrize(
    "wrong", [{"angle_deg": 0.0}, {"cone_deg": 60.0}, {"rounds": 0}, {"border_px": -1}, {"planes": 255}, {"samples": 0}, {"tiles": 1}]
)
def test_ranges(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ConnectedComponents(**wrong)


def test_none(analytic):
    frame = analytic.frame(np.ones((480, 640)))
    planes = NoPlanes()(IntegralImage()(frame))
    assert len(planes.pixels) == 0 and planes.labels.shape == (240, 320) and not planes.labels.any() and planes.index == 7
