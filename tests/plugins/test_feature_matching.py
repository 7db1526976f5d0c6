"""Gated matching of points, lines and planes, against brute force and known twins."""

import numpy as np
import pytest

from trihedron.plugins.shared.feature_matching import associate_planes, match_lines, match_near


def scene(rng, n, noise_px=2.0, flipped_bits=10):
    """n described points, and the same seen again: moved, some bits flipped, shuffled by `order`."""
    px = (rng.random((n, 2)) * [640, 480]).astype(np.float32)
    descriptors = rng.integers(0, 256, (n, 32), dtype=np.uint8)
    octaves = rng.integers(0, 8, n).astype(np.uint8)
    order = rng.permutation(n)
    bits = np.unpackbits(descriptors, axis=1)
    for row in bits:
        row[rng.choice(256, flipped_bits, replace=False)] ^= 1
    moved = (px + rng.uniform(-noise_px, noise_px, (n, 2))).astype(np.float32)
    return (px, descriptors, octaves), (moved[order], np.packbits(bits, axis=1)[order], octaves[order]), order


def reference(query, train, radius, step, limit, ratio):
    """The documented rule, written plainly."""
    (qp, qd, qo), (tp, td, to) = query, train
    chosen = {}
    for i in range(len(qp)):
        gate = (np.linalg.norm(tp - qp[i], axis=1) <= radius[i]) & (np.abs(to.astype(int) - int(qo[i])) <= step)
        rows = np.flatnonzero(gate)
        if len(rows) == 0:
            continue
        distance = np.array([np.unpackbits(qd[i] ^ td[j]).sum() for j in rows])
        best = int(np.argmin(distance))
        others = [d for k, d in enumerate(distance) if k != best and to[rows[k]] == to[rows[best]]]
        if distance[best] > limit or (others and distance[best] >= ratio * min(others)):
            continue
        j = rows[best]
        if j not in chosen or distance[best] < chosen[j][0]:
            chosen[j] = (distance[best], i)
    out = np.full(len(qp), -1)
    for j, (_, i) in chosen.items():
        out[i] = j
    return out


@pytest.mark.parametrize("seed,step,ratio,radius", [(0, 8, 0.95, 200.0), (1, 1, 0.9, 120.0), (2, 0, 1.0, 300.0)])
def test_equals_brute_force(seed, step, ratio, radius):
    rng = np.random.default_rng(seed)
    query, train, _ = scene(rng, 150, flipped_bits=60)
    query[0][:5] = np.nan
    train[0][7:9] = np.inf
    radii = rng.uniform(0.2, 1.0, 150).astype(np.float32) * np.float32(radius)
    found = match_near(*query, *train, radii, step, 100, ratio)
    assert np.array_equal(found, reference(query, train, radii, step, 100, ratio))
    assert (found >= 0).sum() > 20 and np.all(found[:5] == -1)
    used = found[found >= 0]
    assert len(np.unique(used)) == len(used)


def test_finds_every_twin_and_no_other():
    query, train, order = scene(np.random.default_rng(3), 1000)
    found = match_near(*query, *train, np.full(1000, 5.0, np.float32), 0, 20, 0.8)
    assert np.array_equal(order[found], np.arange(1000))
    assert np.all(match_near(*query, *train, np.full(1000, 5.0, np.float32), 0, 9, 0.8) == -1)  # ten bits differ


def test_euclidean_metric_and_positions_alone():
    (px, descriptors, octaves), train, order = scene(np.random.default_rng(5), 200, noise_px=0.1)
    radius = np.full(200, 1.0, np.float32)
    near = np.clip(descriptors.astype(int) + 3, 0, 255).astype(np.uint8)[order]
    distance = np.linalg.norm(near.astype(float) - descriptors[order].astype(float), axis=1)
    limit = int(np.median(distance))
    found = match_near(px, descriptors, octaves, train[0], near, train[2], radius, 0, limit, 1.0, metric="l2")
    assert np.array_equal(found[order] >= 0, distance <= limit)
    blank = np.zeros((200, 0), np.uint8)
    assert np.array_equal(order[match_near(px, blank, octaves, train[0], blank, train[2], radius, 0, 50, 1.0)], np.arange(200))


def test_empty_input_and_wrong_arguments():
    (px, descriptors, octaves), _, _ = scene(np.random.default_rng(6), 4)
    none = (np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), np.zeros(0, np.uint8))
    radius = np.full(4, 9.0, np.float32)
    assert np.all(match_near(px, descriptors, octaves, *none, radius, 8, 60, 0.9) == -1)
    assert len(match_near(*none, px, descriptors, octaves, radius[:0], 8, 60, 0.9)) == 0
    with pytest.raises(ValueError, match="metric: 'cosine'"):
        match_near(px, descriptors, octaves, px, descriptors, octaves, radius, 8, 60, 0.9, metric="cosine")
    with pytest.raises(ValueError, match="32 and 16 bytes"):
        match_near(px, descriptors, octaves, px, descriptors[:, :16], octaves, radius, 8, 60, 0.9)


def segments(rng, n):
    """n image segments of 40 to 140 px with descriptors."""
    angle, half = rng.uniform(0, np.pi, n), rng.uniform(20, 70, n)
    step = np.stack([np.cos(angle), np.sin(angle)], axis=1) * half[:, None]
    middle = rng.random((n, 2)) * [640, 480]
    return np.stack([middle - step, middle + step], axis=1).astype(np.float32), rng.integers(0, 256, (n, 32), dtype=np.uint8)


def test_lines_found_shifted_shortened_and_reversed():
    lines, descriptors = segments(np.random.default_rng(7), 120)
    along = lines[:, 1] - lines[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    seen = (lines + 3.0 * normal[:, None]).astype(np.float32)
    seen[:, 1] = seen[:, 0] + 0.6 * (seen[:, 1] - seen[:, 0])  # 60 % of its length
    seen = seen[::-1, ::-1]  # other order, other way round
    found = match_lines(lines, descriptors, seen, descriptors[::-1], 3.0, 4.0, 0.9, 30, 0.9)
    assert np.array_equal(found, np.arange(120)[::-1])
    assert np.all(match_lines(lines, descriptors, seen, descriptors[::-1], 3.0, 2.0, 0.9, 30, 0.9) == -1)  # three pixels beside it
    alone = match_lines(lines, descriptors, seen, descriptors[::-1], 3.0, 4.0, 0.9, -1, 1.0)  # geometry without descriptors
    assert (alone == np.arange(120)[::-1]).mean() > 0.9


def test_lines_gate_angle_and_overlap_and_ratio():
    line = np.array([[[100, 100], [200, 100]]], np.float32)
    tilted = np.array([[[100, 90], [200, 110]]], np.float32)  # 11.3°, same middle
    beyond = line + np.float32([80, 0])  # overlaps by 20 %
    blank = np.zeros((1, 32), np.uint8)
    assert match_lines(line, blank, tilted, blank, 10.0, 5.0, 0.5, 10, 1.0)[0] == -1
    assert match_lines(line, blank, tilted, blank, 12.0, 5.0, 0.5, 10, 1.0)[0] == 0
    assert match_lines(line, blank, beyond, blank, 10.0, 5.0, 0.3, 10, 1.0)[0] == -1
    assert match_lines(line, blank, beyond, blank, 10.0, 5.0, 0.1, 10, 1.0)[0] == 0
    twin = np.concatenate([line, line + np.float32([0, 4])])  # two parallel edges, equally similar
    piece = np.concatenate([line, line + np.float32([30, 0])])  # two pieces of one edge
    assert match_lines(line, blank, twin, blank.repeat(2, 0), 10.0, 5.0, 0.5, 10, 0.9)[0] == -1
    assert match_lines(line, blank, piece, blank.repeat(2, 0), 10.0, 5.0, 0.5, 10, 0.9)[0] == 0
    broken = np.full((1, 2, 2), np.nan, np.float32)
    assert match_lines(broken, blank, line, blank, 10.0, 5.0, 0.5, 10, 1.0)[0] == -1
    assert len(match_lines(line[:0], blank[:0], line, blank, 10.0, 5.0, 0.5, 10, 1.0)) == 0


def patch(rng, normal, d, centre, size=0.5, count=64):
    """Coefficients (4,) and samples (count, 3) of a square patch of the plane around the point nearest `centre`."""
    n = np.asarray(normal, float) / np.linalg.norm(normal)
    middle = np.asarray(centre, float) - (np.asarray(centre) @ n + d) * n
    basis = np.linalg.svd(n[None])[2][1:]
    return np.append(n, d), (middle + rng.uniform(-size, size, (count, 2)) @ basis).astype(np.float32)


def stack(*patches):
    return np.array([p[0] for p in patches]).reshape(-1, 4), np.array([p[1] for p in patches], np.float32).reshape(len(patches), -1, 3)


def test_planes_mean_distance_keeps_offset_planes_apart():
    rng = np.random.default_rng(8)
    wall, front = patch(rng, [0, 0, -1], 3.0, [0, 0, 3]), patch(rng, [0, 0, -1], 2.85, [1, 0, 3])
    tilt = np.radians(4.0)
    leaning = patch(rng, [np.sin(tilt), 0, -np.cos(tilt)], 2.99, [1.2, 0, 3])  # touches the front plane somewhere
    pairs = associate_planes(*stack(front, wall), *stack(wall, front), 10.0, 0.1)
    assert pairs.tolist() == [[0, 1], [1, 0]]
    assert associate_planes(*stack(wall), *stack(front), 10.0, 0.1).tolist() == []
    assert associate_planes(*stack(leaning), *stack(patch(rng, [0, 0, -1], 3.4, [-1, 0, 3])), 10.0, 0.1).tolist() == []


def test_planes_overlap_chooses_among_equals_and_pieces_share_a_wall():
    rng = np.random.default_rng(9)
    left, right = patch(rng, [0, 0, -1], 3.0, [-1, 0, 3]), patch(rng, [0, 0, -1], 3.0, [1, 0, 3])
    assert associate_planes(*stack(right, left), *stack(left, right), 10.0, 0.1).tolist() == [[0, 1], [1, 0]]
    whole = patch(rng, [0, 0, -1], 3.0, [0, 0, 3], size=2.0)
    assert associate_planes(*stack(left, right), *stack(whole), 10.0, 0.1, many_to_one=True).tolist() == [[0, 0], [1, 0]]
    assert len(associate_planes(*stack(left, right), *stack(whole), 10.0, 0.1)) == 1


def test_planes_two_faces_nan_samples_and_nothing():
    rng = np.random.default_rng(10)
    wall = patch(rng, [0, 0, -1], 3.0, [0, 0, 3])
    back = (-wall[0], wall[1])
    assert len(associate_planes(*stack(wall), *stack(back), 10.0, 0.1)) == 0
    holes = wall[1].copy()
    holes[10:] = np.nan
    assert associate_planes(*stack((wall[0], holes)), *stack(wall), 10.0, 0.1).tolist() == [[0, 0]]
    blind = (wall[0], np.full_like(holes, np.nan))
    assert len(associate_planes(*stack(blind), *stack(blind), 10.0, 0.1)) == 0
    none = np.zeros((0, 4)), np.zeros((0, 64, 3), np.float32)
    assert associate_planes(*none, *stack(wall), 10.0, 0.1).shape == (0, 2)
    assert associate_planes(*stack(wall), *none, 10.0, 0.1).shape == (0, 2)
