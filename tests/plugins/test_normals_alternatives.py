"""OpenCV's normals on surfaces whose normals are known."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from trihedron.plugins.normals.cross_product import CrossProduct
from trihedron.plugins.normals.fals import Fals
from trihedron.plugins.normals.sri import Sri

BORDER = {Fals: 0, Sri: 6, CrossProduct: 1}  # cells along the image's border without a normal
NEAR = {Fals: 2, Sri: 4, CrossProduct: 1}  # and beside a depth edge
EXACT = {Fals: 0.02, Sri: 0.7, CrossProduct: 0.01}  # deg; SRI interpolates between rays
each = pytest.mark.parametrize("plugin", BORDER, ids=lambda plugin: plugin.__name__)


def errors_deg(normals, truth):
    """Angle of every finite normal to the unit vector."""
    truth = np.asarray(truth, float) / np.linalg.norm(truth)
    found = normals[np.isfinite(normals[..., 0])].astype(float)
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(found, truth), axis=-1), found @ truth))


@each
@pytest.mark.parametrize("normal", [(0, 0, -1), (0.3, -0.4, -1), (-1, 0.1, -0.6), (0.02, -1, -0.3), (-1, 0.0, 0.2)])
def test_plane_is_exact_and_faces_the_camera(analytic, plugin, normal):
    depth = analytic.plane(normal, 0.4 if normal[2] > 0 else 1.4)  # the last one is seen although its normal points away in z
    result = plugin()(analytic.frame(depth))
    assert result.normals.shape == (240, 320, 3) and result.stride == 2 and (result.index, result.stamp_ns) == (7, 7_000)
    assert errors_deg(result.normals, normal).max() < EXACT[plugin]
    if normal == (0, 0, -1):
        b = BORDER[plugin]
        assert np.isfinite(result.normals[b : 240 - b, b : 320 - b]).all()


@each
@pytest.mark.parametrize("gap", [0, 6])
def test_depth_edge_gives_no_bogus_normal(analytic, plugin, gap):
    depth = np.full((480, 640), 1.0)
    depth[:, 321:] = 2.0  # in the middle of a cell
    depth[:, 321 : 321 + gap] = 0.0  # the sensor's shadow
    result = plugin()(analytic.frame(depth)).normals
    assert errors_deg(result, (0, 0, -1)).max() < EXACT[plugin]
    b, near = BORDER[plugin], NEAR[plugin] + 1
    assert np.isfinite(result[b : 240 - b, b : 160 - near]).all() and np.isfinite(result[b : 240 - b, 161 + gap // 2 + near : 320 - b]).all()


@each
def test_missing_depth_is_not_a_point_at_the_camera(analytic, plugin):
    truth = (0.3, -0.4, -1.0)
    depth = analytic.plane(truth, 2.0)
    depth[100:200, 100:300] = np.nan
    depth[np.random.default_rng(3).random(depth.shape) < 0.001] = 0.0
    result = plugin()(analytic.frame(depth)).normals
    assert errors_deg(result, truth).max() < EXACT[plugin]
    assert np.isnan(result[50:100, 50:150]).all()
    assert np.isfinite(result[..., 0]).mean() > (0.85 if plugin is CrossProduct else 0.6)


@each
def test_crease_is_smoothed_within_a_window_and_no_further(analytic, plugin):
    left, right = (-0.5, 0.0, -1.0), (0.5, 0.0, -1.0)
    result = plugin()(analytic.frame(np.minimum(analytic.plane(left, 2.0), analytic.plane(right, 2.0)))).normals
    columns = np.arange(320) * 2
    for side, truth in ((columns < 319 - 12, right), (columns > 319 + 12, left)):
        assert errors_deg(result[:, side], truth).max() < EXACT[plugin]


@each
def test_averaged_points_keep_the_sensors_noise_in_bounds(analytic, plugin):
    for z, limit in ((1.0, 2.0), (2.0, 3.2)):
        frame = analytic.frame(analytic.noisy(np.full((480, 640), z)), analytic.sensor)
        rms = [np.sqrt(np.mean(errors_deg(p(frame).normals, (0, 0, -1)) ** 2)) for p in (plugin(), plugin(max_patch_px=1))]
        assert rms[0] < limit and rms[0] < 0.6 * rms[1]


@each
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_nothing_measured_gives_no_normals(analytic, plugin, value):
    assert np.isnan(plugin()(analytic.frame(np.full((480, 640), value))).normals).all()


@each
@pytest.mark.parametrize(("shape", "stride"), [((77, 101), 3), ((33, 47), 1), ((5, 9), 2), ((2, 2), 2), ((1, 1), 1)])
def test_any_image_size(analytic, plugin, shape, stride):
    result = plugin(stride=stride)(analytic.frame(np.full(shape, 1.5)))
    assert result.normals.shape == (-(-shape[0] // stride), -(-shape[1] // stride), 3)
    assert (errors_deg(result.normals, (0, 0, -1)) < EXACT[plugin]).all()
    assert shape[0] < 33 or np.isfinite(result.normals).any()


@each
def test_one_stage_for_frames_of_different_cameras_in_two_threads(analytic, plugin):
    """An OpenCV object holds the tables of one camera: the answer must not depend on what it saw before."""
    other = replace(analytic.sensor, fx=400.0, cx=300.0)
    frames = [analytic.frame(analytic.noisy(analytic.plane((0.2, 0.3, -1), 2.0, c), c), c) for c in (analytic.sensor, other)] * 3
    alone = [plugin()(frame).normals.tobytes() for frame in frames]
    stage = plugin()
    with ThreadPoolExecutor(2) as pool:
        for _ in range(2):
            assert [result.normals.tobytes() for result in pool.map(stage, frames)] == alone


@each
@pytest.mark.parametrize("wrong", [{"stride": 0}, {"max_patch_px": 0}, {"noise_deg": 0.0}, {"jump": -1.0}, {"jump_m": 0.0}])
def test_ranges(plugin, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        plugin(**wrong)


@pytest.mark.parametrize("plugin", [Fals, Sri])
def test_window(plugin):
    with pytest.raises(ValueError, match="window"):
        plugin(window=4)
