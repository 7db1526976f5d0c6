"""3D lines along image segments whose depth is known."""

import numpy as np
import pytest

from trihedron.pipeline.core.types import LineSegments
from trihedron.plugins.none import NoSegments
from trihedron.plugins.segments.ransac import Ransac


def lines(*endpoints):
    e = np.array(endpoints, np.float32).reshape(-1, 2, 2)
    return LineSegments(7, 7_000, e, np.arange(len(e) * 32, dtype=np.uint8).reshape(-1, 32))


def on_plane(camera, pixels, normal, d):
    """Back-projection (…, 3) of pixels onto a plane."""
    ray = camera.back_project(np.asarray(pixels, float), np.ones(np.shape(pixels)[:-1]))
    n = np.asarray(normal, float) / np.linalg.norm(normal)
    return ray * (-d / (ray @ n))[..., None]


STEEP = ((0.75, 0.1, -0.65), 1.5)
SEGMENTS = (((20, 30), (615, 440)), ((400.3, 100.7), (80.2, 130.4)), ((200, 450), (202, 20)))


@pytest.mark.parametrize("plane", [((0, 0, -1), 2.0), ((0.3, -0.4, -1), 1.5), STEEP])
def test_lines_on_a_plane_are_exact_whatever_their_length(analytic, plane):
    depth = analytic.plane(*plane)
    found = Ransac()(analytic.frame(depth), lines(*SEGMENTS))
    truth = on_plane(analytic.exact, np.array(SEGMENTS, float), *plane)
    seen = truth[..., 2] < 8.0
    assert found.endpoints_m.shape == (3, 2, 3) and found.descriptors.tobytes() == lines(*SEGMENTS).descriptors.tobytes()
    assert np.abs(found.endpoints_m - truth)[seen].max() < 0.002


def test_a_line_on_an_occluding_edge_takes_the_nearer_surface(analytic):
    depth = np.full((480, 640), 3.0)
    depth[100:400, 200:400] = 1.2
    depth[100:400, 400:405] = 0.0  # shadow of the sensor
    edges = [((x, 390), (x, 110)) for x in (198.6, 199.4, 200.3, 399.4, 400.3, 401.4)]
    found = Ransac()(analytic.frame(depth), lines(*edges))
    assert np.abs(found.endpoints_m[..., 2] - 1.2).max() < 1e-3


def test_a_texture_line_beside_nothing_keeps_its_own_depth(analytic):
    depth = np.full((480, 640), 3.0)
    depth[:, 320:] = 1.2
    found = Ransac()(analytic.frame(depth), lines(((300, 20), (300, 400)), ((340, 20), (340, 400))))
    assert np.allclose(found.endpoints_m[..., 2], [[3.0], [1.2]], atol=1e-3)


def test_missing_ends_shorten_the_line_and_a_line_without_depth_stays_as_a_row(analytic):
    depth = np.full((480, 640), 2.0)
    depth[:, :100], depth[:, 540:], depth[300:310] = 0.0, np.nan, 0.0
    found = Ransac()(analytic.frame(depth), lines(((20, 200), (620, 200)), ((600, 305), (20, 305)), ((620, 200), (20, 200))))
    pixels = analytic.exact.project(found.endpoints_m.astype(float))
    assert np.abs(pixels[0, :, 0] - [100, 540]).max() < 10.0 and np.abs(pixels[2, :, 0] - [540, 100]).max() < 10.0  # in the order of the pixels
    assert np.isnan(found.endpoints_m[1]).all() and np.isnan(found.covariance_m2[1]).all() and len(found.endpoints_px) == 3


def test_outliers_do_not_bend_the_line(analytic):
    depth = analytic.plane((0.3, 0, -1), 1.8)
    bad = np.random.default_rng(1).random((480, 640)) < 0.3
    depth[bad] += 0.4
    segment = ((50, 240), (590, 250))
    found = Ransac()(analytic.frame(analytic.noisy(depth), analytic.sensor), lines(segment))
    truth = on_plane(analytic.sensor, np.array(segment, float), (0.3, 0, -1), 1.8)
    assert np.linalg.norm(found.endpoints_m[0] - truth, axis=1).max() < 0.015


def test_acceptance_is_a_share_of_the_samples_taken(analytic):
    depth = np.full((480, 640), 2.0)
    depth[:, 250:] = 3.0 + np.sin(np.arange(390) / 9.0)
    whole = ((10, 240), (630, 240))  # 39 % of it on the wall
    assert np.isnan(Ransac()(analytic.frame(depth), lines(whole)).endpoints_m).all()
    assert np.isfinite(Ransac(share=0.3)(analytic.frame(depth), lines(whole)).endpoints_m).all()


def test_covariance_is_that_of_the_noise(analytic):
    """Monte Carlo: independent noise, so every sample counts and nothing is common to them."""
    plane, segment = ((0.4, 0.1, -1), 2.0), ((100, 100), (500, 300))
    truth = on_plane(analytic.sensor, np.array(segment, float), *plane)
    depth, stage, chi2 = analytic.plane(*plane), Ransac(correlation_px=0.0, bias=0.0, side_px=0), []
    for seed in range(60):
        found = stage(analytic.frame(analytic.noisy(depth, seed=seed), analytic.sensor), lines(segment))
        for e in range(2):
            ray = truth[e] / np.linalg.norm(truth[e])
            variance = ray @ found.covariance_m2[0, e].astype(float) @ ray
            chi2.append((ray @ (found.endpoints_m[0, e] - truth[e])) ** 2 / variance)
    assert 0.3 < np.mean(chi2) < 1.3  # 0.4 to 1: interpolation averages up to four of the noisy depths


def test_covariance_is_positive_and_lateral_error_is_in_pixels(analytic):
    found = Ransac(sigma_px=1.0)(analytic.frame(np.full((480, 640), 2.0)), lines(((320, 100), (320, 400))))
    assert np.linalg.eigvalsh(found.covariance_m2[0].astype(float)).min() > 0.0
    assert abs(np.sqrt(found.covariance_m2[0, 0, 0, 0]) - 2.0 / 525.0) < 1e-4


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_nothing_measured(analytic, value):
    found = Ransac()(analytic.frame(np.full((480, 640), value)), lines(*SEGMENTS))
    assert len(found.endpoints_m) == 3 and np.isnan(found.endpoints_m).all()


def test_degenerate_segments(analytic):
    odd = (((5, 5), (5, 5)), ((np.nan, 0), (10, 10)), ((-500, -500), (-100, -200)), ((1e9, 0), (0, 1e9)), ((-50, 100), (700, 100)))
    found = Ransac()(analytic.frame(np.full((480, 640), 2.0)), lines(*odd))
    assert np.isnan(found.endpoints_m[:4]).all() and np.isfinite(found.endpoints_m[4]).all()
    assert Ransac()(analytic.frame(np.full((480, 640), 2.0)), lines()).endpoints_m.shape == (0, 2, 3)


def test_same_input_same_bytes(analytic):
    frame = analytic.frame(analytic.noisy(analytic.plane((0.2, 0.3, -1), 2.0)), analytic.sensor)
    a, b = (Ransac()(frame, lines(*SEGMENTS)) for _ in range(2))
    assert a.endpoints_m.tobytes() == b.endpoints_m.tobytes() and a.covariance_m2.tobytes() == b.covariance_m2.tobytes()


@pytest.mark.parametrize("wrong", [{"samples": 1}, {"side_px": 21}, {"gate": 0.0}, {"share": 1.5}, {"sigma_px": 0.0}, {"bias": -1.0}])
def test_ranges(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Ransac(**wrong)


def test_none(analytic):
    found = NoSegments()(lines(*SEGMENTS))
    assert found.endpoints_m.shape == (0, 2, 3) and found.descriptors.shape == (0, 32)
