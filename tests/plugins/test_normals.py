"""Normals on surfaces whose normals are known."""

import numpy as np
import pytest

from trihedron.plugins.none import NoNormals
from trihedron.plugins.normals.integral_image import IntegralImage
from trihedron.plugins.normals.patch_size import patch_radii


def errors_deg(normals, truth):
    """Angle of every finite normal to the unit vector."""
    found = normals[np.isfinite(normals[..., 0])].astype(float)
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(found, truth), axis=-1), found @ truth))


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.3, -0.4, -1), (-1, 0.1, -0.6), (0.02, -1, -0.3)])
def test_plane_is_exact_everywhere_even_at_the_image_border(analytic, normal):
    depth = analytic.plane(normal, 1.4)
    truth = np.array(normal) / np.linalg.norm(normal)
    result = IntegralImage()(analytic.frame(depth))
    assert result.normals.shape == (240, 320, 3) and result.stride == 2 and (result.index, result.stamp_ns) == (7, 7_000)
    smooth = analytic.plane(normal, 1.4)[::2, ::2]
    near = (smooth > 0.0) & (smooth < 3.0)
    assert errors_deg(result.normals[near], truth).max() < 0.1
    assert np.isfinite(result.normals[near]).mean() > 0.98


def test_missing_depth_is_left_out_not_taken_for_zero(analytic):
    truth = np.array([0.3, -0.4, -1.0]) / np.linalg.norm([0.3, -0.4, -1.0])
    depth = analytic.plane(truth, 2.0)
    holes = np.random.default_rng(3).random(depth.shape) < 0.3
    depth[holes] = 0.0
    depth[100:200, 100:300] = np.nan
    result = IntegralImage()(analytic.frame(depth)).normals
    assert errors_deg(result, truth).max() < 0.1
    assert np.isnan(result[55:95, 55:145]).all()
    assert np.isfinite(result[120:, :]).all(-1).mean() > 0.98  # a block is empty in 0.3⁴ of the cases


@pytest.mark.parametrize("gap", [0, 6])
def test_depth_edge_breaks_the_patch(analytic, gap):
    depth = np.full((480, 640), 1.0)
    depth[:, 320:] = 2.0
    depth[:, 320 : 320 + gap] = 0.0  # the sensor's shadow
    result = IntegralImage()(analytic.frame(depth)).normals
    assert errors_deg(result, np.array([0.0, 0.0, -1.0])).max() < 0.1
    assert np.isfinite(result[..., 0]).mean() > 0.96


def test_crease_is_smoothed_within_a_patch_and_no_further(analytic):
    left, right = (-0.5, 0.0, -1.0), (0.5, 0.0, -1.0)
    depth = np.minimum(analytic.plane(left, 2.0), analytic.plane(right, 2.0))
    result = IntegralImage()(analytic.frame(depth)).normals
    columns = np.arange(320) * 2
    for side, truth in ((columns < 319 - 7, right), (columns > 319 + 7, left)):
        assert errors_deg(result[:, side], np.array(truth) / np.linalg.norm(truth)).max() < 0.1


def test_patch_grows_where_the_sensor_is_noisy(analytic):
    small, grown = IntegralImage(max_patch_px=10), IntegralImage()
    for z, limit in ((1.0, 1.5), (1.5, 2.0), (2.0, 2.0)):
        depth = analytic.noisy(np.full((480, 640), z))
        rms = [np.sqrt(np.mean(errors_deg(n(analytic.frame(depth, analytic.sensor)).normals, np.array([0, 0, -1.0])) ** 2)) for n in (small, grown)]
        assert rms[1] < limit and (z < 1.2 or rms[1] < 0.3 * rms[0])
    assert set(patch_radii(analytic.exact, grown.noise_deg, grown.patch_px, grown.max_patch_px, grown.stride)[11:]) == {2}  # 10 px on exact depth


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_nothing_measured_gives_no_normals(analytic, value):
    assert np.isnan(IntegralImage()(analytic.frame(np.full((480, 640), value))).normals).all()


@pytest.mark.parametrize(("shape", "stride"), [((77, 101), 3), ((5, 9), 2), ((1, 1), 1)])
def test_any_image_size(analytic, shape, stride):
    result = IntegralImage(stride=stride)(analytic.frame(np.full(shape, 1.5)))
    assert result.normals.shape == (-(-shape[0] // stride), -(-shape[1] // stride), 3)
    assert not result.normals[np.isfinite(result.normals[..., 0])].size or errors_deg(result.normals, np.array([0, 0, -1.0])).max() < 0.1


def test_same_input_same_bytes(analytic):
    frame = analytic.frame(analytic.noisy(analytic.plane((0.2, 0.3, -1), 2.0)), analytic.sensor)
    assert IntegralImage()(frame).normals.tobytes() == IntegralImage()(frame).normals.tobytes()


@pytest.mark.parametrize("wrong", [{"stride": 0}, {"patch_px": 4}, {"patch_px": 30}, {"noise_deg": 0.0}, {"jump_m": 0.0}, {"share": 0.0}])
def test_ranges(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong)).split("_m")[0]):
        IntegralImage(**wrong)


def test_none(analytic):
    result = NoNormals()(analytic.frame(np.ones((480, 640))))
    assert result.normals.shape == (240, 320, 3) and np.isnan(result.normals).all()
    with pytest.raises(ValueError, match="stride"):
        NoNormals(stride=0)
