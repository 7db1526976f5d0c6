"""Calibration from points of pairs of frames, and its judgement on blocks that were held out."""

from __future__ import annotations

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.types import F64, Camera
from trihedron.tools.calibrate import CHANGES, READOUTS, _by_pairs
from trihedron.tools.calibration_judgement import Judgement, blocks_of, judge
from trihedron.tools.calibration_pairs import NAMES, Observations, Pairs, fit, scale_of

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
FRAMES, POINTS = 24, 40
TRUTH = {"log_focal": 0.02, "depth_offset": 0.01, "depth_radial": -0.015, "readout_s": 0.025, "delay_s": 0.012, "depth_readout_s": 0.02}


def pose(t: float) -> F64:
    rotation = exp_so3(np.array([0.25 * np.sin(3.1 * t), 0.3 * np.sin(2.3 * t + 1.0), 0.15 * np.sin(1.7 * t)]))
    return pose_matrix(rotation, np.array([0.4 * np.sin(1.3 * t), 0.2 * np.sin(2.1 * t), 0.5 * np.sin(1.1 * t + 0.5)]))


def motion(t: float) -> F64:
    step = 1e-4
    relative = invert(pose(t - step)) @ pose(t + step)
    rate = np.array([relative[2, 1], relative[0, 2], relative[1, 0]]) / (2.0 * step)
    velocity = pose(t)[:3, :3].T @ (pose(t + step)[:3, 3] - pose(t - step)[:3, 3]) / (2.0 * step)
    return np.concatenate([rate, velocity])


def observed(points: F64, t: float, hidden: dict[str, float], rng: np.random.Generator) -> Observations:
    """Observe points of the world: rows of both images are read one after the other, depth errs as the parameters say, noise is as stated."""
    focal = CAMERA.fx * np.exp(hidden["log_focal"])
    pixels = np.zeros((len(points), 2))
    rows = late = np.zeros(len(points))
    for _ in range(4):
        seen = np.array([invert(pose(t + s)) @ np.append(p, 1.0) for p, s in zip(points, late)])[:, :3]
        pixels = focal * seen[:, :2] / seen[:, 2:] + [CAMERA.cx, CAMERA.cy]
        rows = (pixels[:, 1] - CAMERA.cy) / CAMERA.height
        late = hidden["readout_s"] * rows
    rates = rng.uniform(-1.0, 1.0, len(points))  # of slanted surfaces
    radius2 = ((pixels - [CAMERA.cx, CAMERA.cy]) ** 2).sum(axis=1) / ((CAMERA.width**2 + CAMERA.height**2) / 4.0)
    later = hidden["delay_s"] + hidden["depth_readout_s"] * rows - late
    z = (1.0 + hidden["depth_radial"] * radius2) / (1.0 / seen[:, 2] - hidden["depth_offset"]) + later * rates
    sigma_px, sigma_m = np.full(len(z), 0.5), 0.002 * z
    noisy = pixels + rng.normal(0.0, 0.5, pixels.shape), z + rng.normal(0.0, sigma_m)
    return Observations(*noisy, rates, sigma_px, sigma_m, np.tile(motion(t), (len(z), 1)))


def pairs_of(hidden: dict[str, float], seed: int) -> Pairs:
    rng = np.random.default_rng(seed)
    blocks, times = blocks_of(FRAMES), np.arange(FRAMES) * 0.15
    first, second, motions, of = [], [], [], []
    for i in range(FRAMES):
        for j in (i + 1, i + 3):
            if j < FRAMES and blocks[i] % 2 == blocks[j] % 2:
                local = np.column_stack([rng.uniform(-0.5, 0.5, (POINTS, 2)), np.ones(POINTS)]) * rng.uniform(1.0, 4.0, (POINTS, 1))
                world = local @ pose(times[i])[:3, :3].T + pose(times[i])[:3, 3]
                first.append(observed(world, times[i], hidden, rng))
                second.append(observed(world, times[j], hidden, rng))
                motions.append(invert(pose(times[j])) @ pose(times[i]))
                of.append(blocks[i])
    pair = np.repeat(np.arange(len(of)), POINTS)
    return Pairs(CAMERA, Observations.concatenate(first), Observations.concatenate(second), pair, np.array(motions), np.array(of))


@pytest.mark.parametrize("name", NAMES)
def test_each_hidden_parameter_is_recovered_within_its_deviation(name: str) -> None:
    pairs = pairs_of(dict.fromkeys(NAMES, 0.0) | {name: TRUTH[name]}, 1)
    found, _ = fit(pairs, range(len(NAMES)), scale_of(pairs))
    errors = found.parameters - [TRUTH[one] if one == name else 0.0 for one in NAMES]
    sigmas = np.sqrt(np.diag(found.covariance))
    print(found.parameters, sigmas)
    assert (np.abs(errors) < 4.0 * sigmas + 0.05 * abs(TRUTH[name])).all()
    assert sigmas[NAMES.index(name)] < 0.25 * abs(TRUTH[name])


def test_what_is_wrong_is_recommended_and_nothing_else() -> None:
    judgements: dict[str, Judgement] = {}
    hidden = dict.fromkeys(NAMES, 0.0) | {"depth_radial": TRUTH["depth_radial"], "readout_s": TRUTH["readout_s"]}
    recommended, _ = _by_pairs(pairs_of(hidden, 2), judgements, has_ratio=False)
    print(judgements)
    assert {name for name, found in judgements.items() if found.recommended} == {"depth_radial", "readout_s"}
    assert abs(recommended[2] / TRUTH["depth_radial"] - 1.0) < 0.2 and recommended[0] == recommended[1] == 0.0


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_a_camera_that_is_right_is_left_alone(seed: int) -> None:
    judgements: dict[str, Judgement] = {}
    recommended, _ = _by_pairs(pairs_of(dict.fromkeys(NAMES, 0.0), seed), judgements, has_ratio=False)
    print(judgements)
    assert set(judgements) == {*CHANGES, *READOUTS} and not recommended.any()


def test_a_change_must_help_both_halves_and_most_blocks() -> None:
    def judged(gains: list[float]) -> Judgement:
        return judge(lambda half: (dict.fromkeys(range(half, 12, 2), 1.0), {b: 1.0 - gains[b] for b in range(half, 12, 2)}))

    assert judged([0.1, 0.11, 0.09, 0.1, 0.12, 0.1] * 2).recommended
    assert not judged([0.1, -0.01] * 6).recommended  # one half becomes worse
    assert not judged([2.0, 2.0] + [0.0] * 10).recommended  # two blocks decide
    assert not judged([0.001] * 12).recommended  # too little
    few = judge(lambda half: ({half: 1.0}, {half: 0.1}))
    assert few.blocks == 2 and not few.recommended


def test_blocks_are_consecutive() -> None:
    assert blocks_of(48).tolist() == [k // 4 for k in range(48)] and blocks_of(3).tolist() == [0, 0, 0] and len(blocks_of(0)) == 0
