"""The Manhattan frame: known axes with noise, clutter and missing parts; scenes without one; degenerate input."""

from dataclasses import replace

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.lie import exp_so3, log_so3, rotation_angle_deg
from trihedron.pipeline.core.types import Normals, Planes, Segments
from trihedron.plugins.manhattan.atlanta import Atlanta
from trihedron.plugins.manhattan.mean_shift import MeanShift
from trihedron.plugins.manhattan.mean_shift_kernels import shift_axes
from trihedron.plugins.manhattan.mixture import Mixture
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE, nearest_equivalent

ROWS, COLS, STRIDE = 120, 160, 4


def random_rotation(rng):
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    return exp_so3(2.0 * np.arccos(min(abs(q[3]), 1.0)) * q[:3] / max(np.linalg.norm(q[:3]), 1e-12))


def tilted(rng, directions, sigma_deg):
    """Directions (n, 3) with Gaussian noise in their tangent planes."""
    basis = tangent_basis(directions)
    out = directions + (basis @ rng.normal(0, np.radians(sigma_deg), (len(directions), 2, 1)))[..., 0]
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def spherical(rng, n):
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def normals_of(rng, surfaces, shares, noise_deg, index=0):
    """A grid of normals: `shares[i]` of the cells show direction `surfaces[i]`, the rest has no order; 5 % have none."""
    count = ROWS * COLS
    grid = spherical(rng, count)
    first = 0
    for direction, share in zip(surfaces, shares):
        n = int(share * count)
        grid[first : first + n] = tilted(rng, np.repeat(direction[None], n, axis=0), noise_deg)
        first += n
    grid = grid[rng.permutation(count)]
    grid[rng.random(count) < 0.05] = np.nan
    return Normals(index, index * 33_000_000, grid.reshape(ROWS, COLS, 3).astype(np.float32), STRIDE)


def planes_of(rng, surfaces, shares, sigma_deg, index=0):
    count = len(surfaces)
    n = tilted(rng, np.array(surfaces).reshape(-1, 3), sigma_deg)
    covariance = np.tile(np.diag([np.radians(0.2) ** 2, np.radians(0.2) ** 2, 1e-5]), (count, 1, 1))
    pixels = (np.array(shares[:count]) * ROWS * COLS * STRIDE**2).astype(np.int32)
    blank = np.zeros((ROWS, COLS), np.uint8)
    return Planes(
        index, index * 33_000_000, np.concatenate([n, np.full((count, 1), 2.0)], axis=1), covariance, np.zeros((count, 4, 4)), pixels,
        np.zeros((count, 8, 3), np.float32), blank, STRIDE,
    )  # fmt: skip


def segments_of(rng, directions, sigma_m=0.002, index=0, tilt_deg=0.0):
    """Segments of 0.4 to 1.2 m along the given directions, about 3 m away."""
    n = len(directions)
    along = tilted(rng, np.array(directions).reshape(-1, 3), tilt_deg) * rng.uniform(0.4, 1.2, n)[:, None] * rng.choice([-1.0, 1.0], n)[:, None]
    middle = rng.uniform([-1, -1, 2.5], [1, 1, 3.5], (n, 3))
    ends = np.stack([middle - 0.5 * along, middle + 0.5 * along], axis=1)
    pixels = 500.0 * ends[..., :2] / ends[..., 2:] + [320, 240]
    ends = ends + rng.normal(0, sigma_m, ends.shape)
    covariance = np.tile(np.eye(3, dtype=np.float32) * sigma_m**2, (n, 2, 1, 1)).astype(np.float32)
    return Segments(index, index * 33_000_000, pixels.astype(np.float32), ends.astype(np.float32), covariance, np.zeros((n, 32), np.uint8))


def scene(rng, R, axes=(0, 1, 2), shares=(0.3, 0.3, 0.3), lines=(5, 5, 5), noise_deg=3.0, index=0, plane_deg=0.36):
    """Normals, segments and planes of a room whose axes are the columns of R; `lines` counts segments on each axis."""
    surfaces = [R[:, k] * rng.choice([-1.0, 1.0]) for k in axes]
    along = [R[:, k] for k in range(3) for _ in range(lines[k])]
    normals = normals_of(rng, surfaces, shares, noise_deg, index)
    return normals, segments_of(rng, along, index=index, tilt_deg=0.5), planes_of(rng, surfaces, shares, plane_deg, index)


def error_deg(found, R):
    return rotation_angle_deg(R.T @ nearest_equivalent(found.rotations[0], R))


def test_cube_has_24_rotations_and_the_nearest_is_chosen():
    assert len({tuple(S.ravel()) for S in CUBE}) == 24
    rng = np.random.default_rng(0)
    for S in CUBE:
        R = random_rotation(rng)
        near = R @ exp_so3(rng.normal(0, 0.2, 3))
        assert np.allclose(nearest_equivalent(near @ S, R), near)


@pytest.mark.parametrize(
    "axes,shares,lines,limit_deg",
    [
        ((0, 1, 2), (0.3, 0.3, 0.3), (6, 6, 6), 0.8),
        ((0, 2), (0.4, 0.4), (0, 0, 0), 1.2),  # two planes
        ((0, 2), (0.3, 0.2), (0, 0, 0), 1.2),  # half of it clutter
        ((1,), (0.9,), (6, 0, 6), 1.2),  # one plane and lines
        ((0, 1, 2), (0.7, 0.1, 0.1), (0, 0, 0), 1.2),
    ],
)
def test_axes_from_any_orientation(axes, shares, lines, limit_deg):
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(30):
        R = random_rotation(rng)
        found = MeanShift()(*scene(rng, R, axes, shares, lines), None)
        assert found.supported
        errors.append(error_deg(found, R))
        assert np.isclose(np.linalg.det(found.rotations[0]), 1.0) and np.allclose(found.rotations[0].T @ found.rotations[0], np.eye(3))
    assert max(errors) < limit_deg


def test_lines_alone_with_clutter_and_normals_alone():
    rng = np.random.default_rng(2)
    for _ in range(20):
        R = random_rotation(rng)
        blind = normals_of(rng, [], [], 3.0)
        blind = replace(blind, normals=np.full_like(blind.normals, np.nan))
        lines = segments_of(rng, [R[:, k] for k in (0, 1, 2) for _ in range(7)] + list(spherical(rng, 10)))
        found = MeanShift()(blind, lines, planes_of(rng, [], [], 0.3), None)
        assert found.supported and error_deg(found, R) < 1.0
        again = MeanShift(use_normals=False)(normals_of(rng, [], [], 3.0), lines, planes_of(rng, [], [], 0.3), None)
        assert error_deg(again, R) < 1.0
        n = scene(rng, R, noise_deg=5.0)[0]
        found = MeanShift(use_lines=False)(n, segments_of(rng, spherical(rng, 60)), planes_of(rng, [], [], 0.3), None)
        assert found.supported and error_deg(found, R) < 1.0
        assert np.all(np.isfinite(found.spread)) and np.all(np.abs(np.degrees(found.spread) / np.sqrt(2) - 4.5) < 1.0)  # 5° cut off at the cone


def test_planes_and_lines_refine_what_normals_find():
    rng = np.random.default_rng(3)
    full, blind = [], []
    for _ in range(30):
        R = random_rotation(rng)
        n, s, p = scene(rng, R, shares=(0.2, 0.2, 0.2), noise_deg=6.0)
        full.append(error_deg(MeanShift()(n, s, p, None), R))
        blind.append(error_deg(MeanShift(use_planes=False, use_lines=False)(n, s, p, None), R))
    assert np.median(full) < 0.4 and np.median(full) < np.median(blind) + 0.1


def test_covariance_is_realistic():
    rng = np.random.default_rng(4)
    squares = []
    for k in range(200):
        R = random_rotation(rng)
        axes, lines = [((0, 1, 2), (5, 5, 5)), ((0, 1), (0, 0, 0)), ((2,), (6, 6, 0))][k % 3]
        found = MeanShift()(*scene(rng, R, axes, (0.3,) * len(axes), lines), None)
        near = nearest_equivalent(found.rotations[0], R)
        phi = log_so3(R @ near.T)
        squares.append(phi @ np.linalg.solve(found.covariance[0], phi) / 3.0)
    assert 0.3 < np.mean(squares) < 1.5


def test_permutation_kept_through_a_turn_of_120_degrees():
    rng = np.random.default_rng(5)
    start, axis = random_rotation(rng), spherical(rng, 1)[0]
    previous = None
    for k in range(61):
        R = exp_so3(axis * np.radians(2.0 * k)) @ start
        visible = (0, 1, 2) if k % 7 else (k % 3, (k + 1) % 3)
        previous = MeanShift()(*scene(rng, R, visible, (0.3,) * len(visible), index=k), previous)
        if k == 0:
            named = nearest_equivalent(R, previous.rotations[0]).T @ R
        assert previous.supported and rotation_angle_deg(previous.rotations[0].T @ R @ named.T) < 1.0


def test_found_again_after_a_jump_near_the_previous_naming():
    rng = np.random.default_rng(6)
    R = random_rotation(rng)
    first = MeanShift()(*scene(rng, R), None)
    turned = exp_so3(np.array([0.0, np.radians(30.0), 0.0])) @ first.rotations[0]
    found = MeanShift()(*scene(rng, turned, index=9), first)
    assert found.supported and rotation_angle_deg(turned.T @ found.rotations[0]) < 1.0


def test_old_axes_are_not_a_place_to_start():
    """Two slanted walls near the old axes would do for a start there; the room is what there is most of."""
    rng = np.random.default_rng(10)
    first = MeanShift()(*scene(rng, random_rotation(rng)), None)
    R, turned = first.rotations[0], first.rotations[0] @ exp_so3(np.radians([0.0, 0.0, 30.0]))
    surfaces, shares = [R[:, 0], R[:, 2], turned[:, 0], turned[:, 1]], (0.15, 0.2, 0.3, 0.3)
    for index, expected in ((10, R), (11, turned)):
        value = normals_of(rng, surfaces, shares, 3.0, index), segments_of(rng, [], index=index), planes_of(rng, surfaces, shares, 0.3, index)
        found = MeanShift()(*value, first)
        assert found.supported and rotation_angle_deg(expected.T @ found.rotations[0]) < 1.0


def circle(R, angles):
    return [np.cos(a) * R[:, 0] + np.sin(a) * R[:, 1] for a in angles]


def not_manhattan(rng, R):
    """Name -> (normals, segments, planes) of scenes without a Manhattan frame."""
    slanted = [R[:, 0], np.cos(np.radians(70)) * R[:, 0] + np.sin(np.radians(70)) * R[:, 1]]
    skewed = [R[:, 0], np.sin(np.radians(8)) * R[:, 0] + np.cos(np.radians(8)) * R[:, 1]]
    tower = [R[:, 2], *circle(R, np.radians(np.arange(0, 360, 5)))]
    scattered = segments_of(rng, circle(R, np.pi * rng.random(40)))
    no_lines, no_planes = segments_of(rng, []), planes_of(rng, [], [], 0.3)
    return {
        "slanted walls": (normals_of(rng, slanted, (0.45, 0.45), 3.0), no_lines, planes_of(rng, slanted, (0.45, 0.45), 0.3)),
        "8 degrees off": (normals_of(rng, skewed, (0.45, 0.45), 3.0), no_lines, planes_of(rng, skewed, (0.45, 0.45), 0.3)),
        "no order": (normals_of(rng, [], [], 3.0), segments_of(rng, spherical(rng, 40)), no_planes),
        "one wall": (normals_of(rng, [R[:, 0]], (0.97,), 3.0), no_lines, planes_of(rng, [R[:, 0]], (0.97,), 0.3)),
        "lines any way on a wall": (normals_of(rng, R.T[2:], (0.9,), 3.0), scattered, planes_of(rng, R.T[2:], (0.9,), 0.3)),
        "round tower": (normals_of(rng, tower, (0.3,) + (0.65 / 72,) * 72, 2.0), no_lines, planes_of(rng, [R[:, 2]], (0.3,), 0.3)),
        "nothing": (replace(normals_of(rng, [], [], 3.0), normals=np.full((ROWS, COLS, 3), np.nan, np.float32)), no_lines, no_planes),
    }  # fmt: skip


def test_scenes_without_a_manhattan_frame_are_recognised():
    rng = np.random.default_rng(7)
    claims = {}
    for _ in range(10):
        R = random_rotation(rng)
        previous = MeanShift()(*scene(rng, R), None)
        for name, value in not_manhattan(rng, R).items():
            for before in (None, previous):
                found = MeanShift()(*value, before)
                claims[name] = claims.get(name, 0) + found.supported
                assert found.rotations.shape == (1, 3, 3) and np.allclose(found.rotations[0] @ found.rotations[0].T, np.eye(3))
                assert np.isclose(np.linalg.det(found.rotations[0]), 1.0)
                sigma = np.sqrt(np.linalg.eigvalsh(found.covariance[0]))
                assert found.supported or (np.degrees(sigma[-1]) > 15.0 and np.all(np.isfinite(sigma)))
    assert claims == dict.fromkeys(claims, 0) | {"lines any way on a wall": claims["lines any way on a wall"]}
    assert claims["lines any way on a wall"] <= 3  # of 20


def test_one_wall_still_tells_two_of_three_angles():
    rng = np.random.default_rng(8)
    R = random_rotation(rng)
    previous = MeanShift()(*scene(rng, R), None)
    n, s, p = not_manhattan(rng, previous.rotations[0])["one wall"]
    found = MeanShift()(n, s, p, previous)
    about = previous.rotations[0][:, 0]
    assert not found.supported and np.isnan(found.spread[0, 1]) and np.isfinite(found.spread[0, 0])
    assert np.degrees(np.sqrt(about @ found.covariance[0] @ about)) > 20.0
    across = previous.rotations[0][:, 1]
    assert np.degrees(np.sqrt(across @ found.covariance[0] @ across)) < 1.0
    assert abs(found.rotations[0][:, 0] @ about) > np.cos(np.radians(1.0))


def test_same_bytes_again():
    rng = np.random.default_rng(9)
    R = random_rotation(rng)
    value = scene(rng, R, lines=(30, 30, 30))
    first = MeanShift()(*value, None)
    found = MeanShift()(*value, first)
    assert found.rotations.tobytes() == MeanShift()(*value, first).rotations.tobytes()


@pytest.mark.parametrize(
    "wrong", [{"cone_deg": 0.0}, {"use_normals": False, "use_lines": False}, {"min_share": 2.0}, {"samples": 1}, {"plane_floor_deg": 0.0}]
)
def test_fields_out_of_range(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        MeanShift(**wrong)


@pytest.mark.parametrize("estimator", [Atlanta(), Mixture(), MeanShift()], ids=lambda one: type(one).__name__)
def test_a_hundred_images_without_a_frame_leave_a_rotation(directions, estimator):
    """What is known is handed on from image to image, turned by the one axis in view; rounding errors must not grow with their number."""
    rng = np.random.default_rng(0)
    R = directions.rotation(rng)
    found = directions.estimate(estimator, directions.room(rng, R))
    scenes = directions.without_frame(rng, R)
    for number in range(100):
        found = directions.estimate(estimator, scenes["one wall" if number % 2 else "nothing"], found)
    assert not found.supported
    assert np.abs(found.rotations @ np.swapaxes(found.rotations, 1, 2) - np.eye(3)).max() < 1e-12


def lesser_modes(estimator, directions):
    """Near the previous axes a room, further round a room with more walls, and normals of no plane 8° from one axis: the modes near by are followed,
    not the means, and nothing else is looked for."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        R = directions.rotation(rng)
        other = R @ exp_so3(np.radians([0.0, 0.0, 40.0]))
        surfaces, shares = [*R.T, *other.T[:2], *directions.circle(R, 8.0)], (0.17, 0.14, 0.12, 0.27, 0.2, 0.08)
        value = directions.normals(rng, surfaces, shares, 2.0), directions.segments(rng), directions.planes(rng, surfaces[:5], shares[:5])
        start = exp_so3(np.radians(4.0) * directions.spherical(rng, 1)[0]) @ R
        found = directions.estimate(estimator, value, directions.frame(start))
        assert found.supported and len(found.ids) == 1 and rotation_angle_deg(R.T @ found.rotations[0]) < 1.0


def test_its_characteristic(directions):
    lesser_modes(MeanShift(), directions)


def test_mean_shift_weighs_the_directions():
    """Directions 2° to both sides of an axis, one weighted three times as much: the mode is at the weighted mean, and moves on with the weights."""
    directions = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.radians([-2.0, 2.0])])
    for weights in ([1.0, 3.0], [3.0, 1.0], [2.0, 2.0]):
        found = shift_axes(directions, np.array(weights), np.eye(3), np.radians(12.0), 1e3, 1, 0.0)
        mean = np.array(weights) @ directions
        assert np.allclose(found[:, 0], mean / np.linalg.norm(mean), atol=1e-9) and np.array_equal(found[:, 1:], np.eye(3)[:, 1:])


@pytest.mark.parametrize("tolerance_deg", [0.001, 0.02, 0.2])
def test_mean_shift_ends_with_the_first_step_within_its_tolerance(tolerance_deg):
    """Directions 4° about each axis, the start 6° off: the mode that is returned is a fixed point to within this angle."""
    rng, R = np.random.default_rng(5), exp_so3(np.radians(6.0) * np.full(3, 1.0 / np.sqrt(3.0)))
    directions, weights = tilted(rng, np.repeat(np.eye(3), 150, axis=0), 4.0), np.ones(450)
    limits = np.radians(12.0), np.radians(4.0)
    axes, moved_deg, steps = R, np.inf, 0
    while moved_deg >= tolerance_deg:
        before, axes = axes, shift_axes(directions, weights, axes, *limits, 1, 0.0)
        moved_deg, steps = np.degrees(np.linalg.norm(axes - before, axis=0).max()), steps + 1
    found = shift_axes(directions, weights, R, *limits, 100, np.radians(tolerance_deg))
    assert np.array_equal(found, axes) and 2 < steps < 100
    again = shift_axes(directions, weights, found, *limits, 1, 0.0)
    assert np.degrees(np.linalg.norm(again - found, axis=0).max()) < tolerance_deg
