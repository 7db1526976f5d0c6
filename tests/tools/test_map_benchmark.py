"""`trihedron benchmark map`: its figures on trajectories, poses and maps that are known."""

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.types import Pose, Trajectory
from trihedron.plugins.mapping.landmarks import empty_map
from trihedron.tools.benchmarks.map_benchmark import (  # fmt: skip
    MULTIPLE,
    OWN,
    TIME,
    bytes_of,
    end_drift,
    floor_m2,
    jump,
    line,
    recovery,
    report_cover,
    report_growth,
    report_loop,
)

STEP_NS = 33_000_000


def along(xs, indices=None):
    """A trajectory with the x of each frame."""
    indices = np.arange(len(xs)) if indices is None else np.asarray(indices)
    poses = np.tile(np.eye(4), (len(xs), 1, 1))
    poses[:, 0, 3] = xs
    return Trajectory(indices * STEP_NS, poses)


def poses_of(statuses):
    none = np.zeros(3, np.int32)
    return [Pose(i, i * STEP_NS, np.eye(4), np.eye(6), np.eye(4), -1, none, 0, status, "") for i, status in enumerate(statuses)]


def test_the_drift_is_that_of_the_whole_motion():
    truth = along([0.0, 1.0, 2.0, 1.0, 0.0])
    moved = along(np.array([0.0, 1.0, 2.0, 1.0, 0.03]) + 7.0)
    assert end_drift(moved, truth) == pytest.approx((4.0, 0.03))


def test_recovery_counts_the_frames_that_stay_lost():
    said = poses_of(["ok"] * 10 + ["lost"] * 14 + ["ok"] * 5 + ["lost"] + ["ok"] * 3)
    assert recovery(said, 10, 20) == {"lost_covered": 10, "lost_after": 4, "lost_elsewhere": 1}
    assert recovery(poses_of(["ok"] * 10 + ["lost"] * 20), 10, 20) == {"lost_covered": 10, "lost_after": 10, "lost_elsewhere": 0}


def test_the_jump_is_that_between_both_sides_of_the_cover():
    """A step of 4 cm at the cover, frames 30 to 39; an error that was there before and stays is none."""
    x = 0.01 * np.arange(70)
    truth, said = along(x), poses_of(["ok"] * 30 + ["lost"] * 10 + ["ok"] * 30)
    seen = [index for index in range(70) if not 30 <= index < 40]
    found = jump(said, along((x + 0.5 + 0.04 * (np.arange(70) > 35))[seen], seen), truth, 30, 10)
    assert found == pytest.approx({"jump_m": 0.04, "jump_deg": 0.0}, abs=1e-9)
    assert jump(said, along((x + 0.5)[seen], seen), truth, 30, 10)["jump_m"] == pytest.approx(0.0, abs=1e-12)
    assert jump(said, along(x[:30]), truth, 30, 10)["jump_m"] == np.inf
    short = jump(said[:46], along((x + 0.04 * (np.arange(70) > 35))[:46]), along(x[:46]), 30, 10)  # six frames after the cover
    assert short == pytest.approx({"jump_m": 0.04, "jump_deg": 0.0}, abs=1e-9)


def test_growth_is_that_of_a_straight_line_whatever_single_frames_do():
    frames = np.arange(0, 2100)
    values = 50.0 + 0.01 * frames
    values[::10] = 900.0
    assert line(frames, values) == pytest.approx([52.0, 70.0], abs=1.5)


def test_floor_is_counted_in_squares_under_what_is_known():
    """Two points over one square, one over another, in a world that is turned against the room; the dead one does not count."""
    R = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    in_room = np.array([[0.1, 0.1, 0.2], [0.4, 0.3, 2.0], [0.6, 0.1, 1.0], [9.0, 9.0, 1.0]])
    map = empty_map(0, 0, 32, 32, 8)
    rows = {name: np.zeros((4, *column.shape), column.dtype) for name, column in map.points.schema.items()}
    rows["position_m"], rows["alive"] = in_room @ R, np.array([True, True, True, False])
    points, _ = map.points.appended(**rows)
    known = type(map)(**{**vars(map), "points": points})
    assert floor_m2(map, R) == 0.0 and floor_m2(known, R) == pytest.approx(0.5)
    assert bytes_of(known) == 4 * sum(np.zeros(column.shape, column.dtype).nbytes for column in points.schema.values())


def test_the_tables_say_what_was_measured():
    loop = {"loop": "none", "frames": 1368, "path_m": 45.6, "drift_m": 0.0114, "drift_percent": 0.025, "ate_m": 0.0041, "tracked_share": 1.0}
    lines = report_loop([loop, loop | {"loop": "planes", "drift_percent": 0.06}]).splitlines()
    assert lines[2].split() == ["none", "1368", "1.000", "11.4", "0.0250", "0.0041"]
    assert lines[-2:] == [
        "met: loop=none: a drift below 0.5 % of the path",
        "NOT MET: loop=planes: a drift below 0.05 % of the path, an ATE below 0.025 m",
    ]
    cover = {"sequence": "a", "frames": 150, "first": 60, "second": 30, "lost_covered": 30, "lost_after": 0, "lost_elsewhere": 0}
    for end, scale in (("", 1.0), ("_covered", 2.0)):
        cover |= {f"jump_m{end}": 0.001 * scale, f"jump_deg{end}": 0.02 * scale, f"ate_m{end}": 0.003 * scale}
    expected = ["a", "150", "60:90", "30", "0", "0", "2.0", "1.0", "0.040", "0.020", "0.0060", "0.0030"]
    lines = report_cover([cover]).splitlines()
    assert lines[2].split() == expected
    assert lines[-2:] == ["met: tracked again within 30 frames, and lost nowhere else", "NOT MET: no jump left"]
    assert report_cover([cover | {"ate_m_covered": 0.004}]).splitlines()[-1] == "met: no jump left"
    assert report_cover([cover | {"lost_after": 30}]).splitlines()[-2].startswith("NOT MET: tracked again")
    names = {TIME: (50.0, 51.0), MULTIPLE: (0.7, 0.8), OWN: (395.0, 405.0)}
    names |= {"memory, MB": (400.0, 440.0), "map, MB": (5.0, 35.0), "floor with landmarks, m²": (20.0, 100.0)}
    lines = report_growth([{"quantity": name, "values": values} for name, values in names.items()]).splitlines()
    assert lines[2].startswith(TIME) and lines[2].split()[-4:] == ["50.00", "51.00", "+2.0", "%"]
    assert lines[-4] == "Per new square metre of floor: 0.50 MB of memory, 0.38 MB of it the map"
    assert [line.split(":")[0] for line in lines[-3:]] == ["met", "NOT MET", "met"]


@pytest.mark.parametrize(
    ("words", "said"),
    [(["--parts", "lop"], "there is no part 'lop'; did you mean 'loop'?"), (["--sequences", "folder"], "--sequences folder has no data set")],
)
def test_mistakes_are_one_line(words, said, capsys):
    assert main(["benchmark", "map", *words]) == 2
    assert said in capsys.readouterr().err
