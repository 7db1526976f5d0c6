"""The detectors of planes beside the connected components: what is their own. What all have in common is in test_planes.py."""

from dataclasses import replace

import numpy as np
import pytest

from trihedron.pipeline.core.types import DepthNoise
from trihedron.plugins.none import NoNormals
from trihedron.plugins.normals.integral_image import IntegralImage
from trihedron.plugins.planes.ahc import Ahc
from trihedron.plugins.planes.ahc_kernels import cluster_blocks
from trihedron.plugins.planes.blocks_kernels import block_mse, block_plane, block_planes, block_sums
from trihedron.plugins.planes.cape import Cape
from trihedron.plugins.planes.curvature_kernels import drop_engulfed, normal_statistics
from trihedron.plugins.planes.ransac import Ransac
from trihedron.plugins.shared.depth_image_kernels import Grid, cell_inverse_depths, cell_rays

CORNER = (((0.6, 0.0, -0.8), 2.2), ((-0.6, 0.0, -0.8), 2.2), ((0.0, -0.96, -0.28), 1.2))
each = pytest.mark.parametrize("plugin", [Ahc, Cape, Ransac], ids=lambda plugin: plugin.__name__)


def detect(plugin, frame, seed=0, normals=None, **fields):
    normals = IntegralImage() if normals is None else normals
    rng = {"rng": np.random.default_rng(seed)} if plugin is Ransac else {}
    return plugin(**fields)(frame, normals(frame), **rng)


def corner(analytic):
    depths = np.stack([analytic.plane(n, d) for n, d in CORNER])
    return np.where(depths > 0.0, depths, np.inf).min(0)


def grid_of(frame, stride=2):
    camera = frame.camera
    rho, sigma, count = cell_inverse_depths(frame.depth_m, stride, 0.04, 0.02, camera.depth_noise.coefficients)
    rays = cell_rays(*rho.shape, stride, (camera.fx, camera.fy, camera.cx, camera.cy))
    return Grid(rho, sigma, count, *rays, IntegralImage()(frame).normals)


@each
def test_depth_alone_is_enough(analytic, plugin):
    """`normals=none` leaves connected components nothing to connect; these detectors do not need any."""
    planes = detect(plugin, analytic.frame(analytic.noisy(corner(analytic)), analytic.sensor), normals=NoNormals())
    assert len(planes.pixels) == 3
    for normal, d in CORNER:
        n = np.array(normal) / np.linalg.norm(normal)
        row = int(np.argmax(planes.coefficients[:, :3] @ n))
        assert np.degrees(np.arccos(planes.coefficients[row, :3] @ n)) < 0.3 and abs(planes.coefficients[row, 3] - d) < 0.01


@each
def test_no_unit_of_length_is_built_in(analytic, plugin):
    """A scene three times as large under a sensor three times as noisy is the same scene."""
    noise = analytic.sensor.depth_noise
    large = DepthNoise(a_m=3.0 * noise.a_m, b=noise.b, c_per_m=noise.c_per_m / 3.0, floor_m=3.0 * noise.floor_m)
    depth = np.minimum(analytic.noisy(corner(analytic)), 3.0)
    depth[300:400, 100:200] = analytic.noisy(np.full((480, 640), 1.1))[300:400, 100:200]
    small = detect(plugin, analytic.frame(depth, analytic.sensor), normals=NoNormals())
    planes = detect(plugin, analytic.frame(3.0 * depth, replace(analytic.sensor, depth_noise=large)), normals=NoNormals())
    assert len(planes.pixels) == len(small.pixels) >= 4 and (planes.labels == small.labels).mean() > 0.98
    assert np.abs(planes.coefficients[:, :3] - small.coefficients[:, :3]).max() < 0.005
    assert np.abs(planes.coefficients[:, 3] / small.coefficients[:, 3] - 3.0).max() < 0.01


@each
def test_speckles_of_missing_depth_do_no_harm(analytic, plugin):
    depth = analytic.plane((0.3, -0.4, -1), 2.0)
    depth[np.random.default_rng(1).random(depth.shape) < 0.2] = 0.0
    planes = detect(plugin, analytic.frame(depth))
    assert len(planes.pixels) == 1 and planes.pixels[0] > 0.95 * (depth > 0.0).sum()


@each
@pytest.mark.parametrize("shape", [(480, 640), (33, 47), (5, 9), (1, 1)])
@pytest.mark.parametrize("stride", [1, 3])
def test_any_image_size_and_stride(analytic, plugin, shape, stride):
    frame = analytic.frame(np.full(shape, 1.5))
    planes = detect(plugin, frame, normals=IntegralImage(stride=stride))
    assert planes.labels.shape == (-(-shape[0] // stride), -(-shape[1] // stride)) and len(planes.pixels) == (shape[0] >= 33)
    assert np.abs(planes.coefficients - [0.0, 0.0, -1.0, 1.5]).max(initial=0.0) < 1e-4


def test_ransac_finds_the_same_planes_whatever_the_draw(analytic):
    frame = analytic.frame(analytic.noisy(corner(analytic)), analytic.sensor)
    found = [detect(Ransac, frame, seed) for seed in (0, 0, 1, 2, 3)]
    assert found[0].coefficients.tobytes() == found[1].coefficients.tobytes() and found[0].labels.tobytes() == found[1].labels.tobytes()
    for planes in found:
        assert len(planes.pixels) == 3
        for normal, d in CORNER:
            assert np.abs(planes.coefficients - [*normal, d]).max(1).min() < 0.01


def test_ransac_takes_connected_regions(analytic):
    """Two tables of one height are one plane to the equation, two regions to the eye."""
    depth = np.full((480, 640), 2.0)
    depth[100:250, 60:260] = depth[100:250, 380:580] = 1.5
    planes = detect(Ransac, analytic.frame(depth))
    assert sorted(np.round(planes.coefficients[:, 3], 2)) == [1.5, 1.5, 2.0]


def test_finer_blocks_find_narrower_planes(analytic):
    """A panel 16 px wide holds blocks of 5 px, none of 20."""
    depth = np.full((480, 640), 2.0)
    depth[100:350, 305:321] = 1.6
    widths = {plugin: len(detect(plugin, analytic.frame(depth), block_px=px).pixels) for plugin, px in ((Ahc, 5), (Cape, 20))}
    assert widths == {Ahc: 2, Cape: 1}


def test_sums_of_blocks_are_those_of_their_union(analytic):
    frame = analytic.frame(analytic.noisy(analytic.plane((0.3, -0.4, -1), 2.0)), analytic.sensor)
    grid = grid_of(frame)
    sums = block_sums(grid, 10, 0.5)
    r, c = np.mgrid[20:40, 50:60]  # blocks (2, 5) and (3, 5)
    rays = np.stack([grid.rays_x[c], grid.rays_y[r], np.ones(c.shape)], axis=-1).reshape(-1, 3)
    rho, weight = grid.rho[20:40, 50:60].ravel().astype(float), np.sqrt(grid.count[20:40, 50:60].ravel()) / grid.sigma[20:40, 50:60].ravel()
    q, residual, _, _ = np.linalg.lstsq(rays * weight[:, None], rho * weight, rcond=None)
    a, b, c0, mse = block_plane(sums[2, 5] + sums[3, 5])
    readings = grid.count[20:40, 50:60].sum()
    assert np.abs(np.array([a, b, c0]) - q).max() < 1e-9 and abs(mse - residual[0] / readings) < 1e-6
    assert abs(block_mse(sums[2, 5] + sums[3, 5], a, b, c0) - mse) < 1e-6
    shifted = ((rays @ [a, b, c0 + 0.01] - rho) ** 2 * weight**2).sum() / readings
    assert abs(block_mse(sums[2, 5] + sums[3, 5], a, b, c0 + 0.01) - shifted) < 1e-6 * shifted


def test_clustering_is_by_least_error_and_stops_at_the_step(analytic):
    depth = np.full((480, 640), 1.5)
    depth[:, 330:] = 1.53
    sums = block_sums(grid_of(analytic.frame(analytic.noisy(depth), analytic.sensor)), 5, 0.75)
    labels, q = cluster_blocks(sums, 4.0, 2.25, 0.64, 500.0)
    assert len(q) == 2 and (labels[:, :33] == labels[0, 0]).all() and (labels[:, 33:] == labels[0, 40]).all()
    together, _ = cluster_blocks(sums, 4.0, 4.0, 100.0, 500.0)
    assert together.max() == 1  # without the limit on what joining may do to a part, the step is swallowed


def test_blocks_without_enough_depth_have_no_plane(analytic):
    depth = np.full((480, 640), 1.5)
    depth[:20, :12] = 0.0
    _, mse = block_planes(block_sums(grid_of(analytic.frame(depth)), 10, 0.5))
    assert np.isinf(mse[0, 0]) and (mse.ravel()[1:] < 0.01).all()


def test_turn_of_a_cylinder_and_of_a_plane(analytic):
    flat, round_ = analytic.plane((0.3, -0.4, -1), 2.0), analytic.cylinder(0.0, 2.0, 0.6)
    for depth, expected in ((flat, 0.0), (round_, 21.0)):
        labels = np.zeros((240, 320), np.int32)
        labels[100:140, 140:181] = 1  # 81 px: 2 asin(40.5 · 1.41 m / 525 / 0.6 m) = 21 degrees, 10.5 to either side
        grid = grid_of(analytic.frame(depth))
        q = np.array([block_plane(block_sums(grid._replace(rho=np.where(labels > 0, grid.rho, 0).astype(np.float32)), 400, 0.0)[0, 0])[:3]])
        turns, _, share = normal_statistics(labels, q, grid, 0.5, 1)
        assert share[0] == 1.0 and abs(np.degrees(turns[0]) - expected) < (0.1 if expected == 0.0 else 1.5)


def test_what_lies_between_curved_strips_is_curved():
    labels = np.zeros((40, 60), np.int32)
    labels[5:35, 10:20], labels[5:35, 20:24], labels[5:35, 24:34], labels[5:35, 44:54] = 1, 2, 3, 4
    rho = np.ones((40, 60), np.float32)
    good = drop_engulfed(labels, rho, np.array([False, True, False, True]), 4)
    assert list(good) == [False, False, False, True]
    assert list(drop_engulfed(labels, rho, np.array([False, True, True, True]), 4)) == [False, True, True, True]


@pytest.mark.parametrize(
    ("plugin", "wrong"),
    [
        (Ahc, {"block_px": 2}), (Ahc, {"share": 0.0}), (Ahc, {"sigma": 0.0}), (Ahc, {"shift_sigma": 0.0}), (Ahc, {"min_pixels": 3}),
        (Cape, {"block_px": 200}), (Cape, {"step_sigma": 0.0}), (Cape, {"angle_deg": 90.0}), (Cape, {"least": 0}), (Cape, {"cone_deg": 0.0}),
        (Ransac, {"hypotheses": 0}), (Ransac, {"rounds": 0}), (Ransac, {"misses": 0}), (Ransac, {"sigma": 0.0}), (Ransac, {"planes": 0}),
    ],
)  # fmt: skip
def test_ranges(plugin, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        plugin(**wrong)
