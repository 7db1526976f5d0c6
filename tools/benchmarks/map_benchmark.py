"""Benchmark of the map: drift around a loop, recovery of a covered camera, growth on a long walk.

Every run is a process of its own. loop: once round the built-in corridor with each loop closer; drift is the error of the motion from the first to
the last pose, in % of the path. cover: the camera is covered for one second in the middle of a sequence; frames that stay lost are counted from the
first one seen again, and the jump is the median error of the motions from the second before to the second after, beside that of the same frames
never covered. growth: a walk through ten rooms; time and memory at frames 200 and 2000 by the straight line through the frames between, so that one
room's furniture does not count, and what the map holds for each square metre of floor that it has landmarks over. The times of the stages after the
features are also given as multiples of those of the feature stages in the same frame, whatever else the machine does meanwhile.

Under each table stands what the map promises of it, and whether it was met. No jump is left when the jump is at most half as much again as without
the cover, and so is the ATE, or both within a millimetre of that.

Example: trihedron benchmark map --sequences tum:FOLDER,icl_nuim:FOLDER --json map.json
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import F64, LOST, Map, Pose, Table, Trajectory
from trihedron.pipeline.record.codec import TIMING_TOPIC, timing_of
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth, read_trajectory
from trihedron.pipeline.run.metrics import associate, relative_errors
from trihedron.tools.arguments import Parser

LOOPS = ("none", "planes", "appearance")
ROOMS = {"built-in room": {}, "built-in room, bare": {"texture": "false"}}
ROOM_FRAMES = "0:150"
SPAN = (200, 2000)  # frames of the long walk that are compared
WALK = "0:2100"
DRIFT_PERCENT, CLOSED_PERCENT, ATE_M = 0.5, 0.05, 0.025  # promised: drift without and with loops, of the path, and the ATE with loops
RECOVERY = 30  # frames after the cover within which the camera is tracked again
LEFT, LEFT_M = 1.5, 0.001  # what may be left of a cover: a factor on, or this much above, the errors of the run that was never covered
GROWTH = 0.1  # share by which time and memory may grow along SPAN
FEATURES = ("normals", "keypoints", "lines", "segments", "planes")  # stages that see the frame alone
TIME, MULTIPLE, OWN = "frame, hand-over to pose, ms", "the same, × the feature stages", "memory without the map, MB"
BOUNDED = (TIME, MULTIPLE, OWN)  # on the long walk; the map itself holds what is new
CELL_M = 0.5  # side of the squares in which floor is counted
Rows = list[dict[str, Any]]
Sequences = dict[str, tuple[str, dict[str, str]]]  # name -> data set's plugin and its options


def main(argv: list[str]) -> int:
    """Run the parts and print their tables; returns the exit code. Raises UsageError for an unknown part, TrihedronError when a run fails."""
    from trihedron.tools.benchmark import machine

    parser = Parser("benchmark map", __name__)
    parser.add_argument("overrides", nargs="*", help="of every run, as for trihedron run")
    parser.add_parts(PARTS)
    parser.add_argument("--sequences", default="", metavar="KIND:FOLDER,...", help="to cover besides the built-in rooms, by plugin")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    options = parser.parse(argv)
    figures: dict[str, Any] = {"machine": machine()}
    with tempfile.TemporaryDirectory() as folder:
        for part in options.parts:
            measure, report = PARTS[part]
            figures[part] = measure(Path(folder), _sequences(options.sequences), options.overrides)
            print(report(figures[part]) + "\n", flush=True)
    if options.json:
        write_file(options.json, json.dumps(figures, indent=2) + "\n")
    return 0


def _sequences(text: str) -> Sequences:
    """Sequences of `KIND:FOLDER,...`, the built-in rooms first."""
    found: Sequences = {name: ("synthetic", options) for name, options in ROOMS.items()}
    for word in filter(None, text.split(",")):
        kind, colon, path = word.partition(":")
        if not colon:
            raise UsageError("benchmark map", f"--sequences {word} has no data set", "give it as KIND:FOLDER, for example tum:FOLDER")
        found[Path(path).name] = kind, {"path": str(Path(path).resolve())}
    return found


def _run(out: Path, words: Sequence[str]) -> tuple[dict[str, Any], Trajectory, Trajectory]:
    """Figures of one run, its final trajectory, and the truth."""
    from trihedron.tools.benchmark import measure

    figures = measure([*words, f"out={out}"], out)
    truth = attached_truth(Recording(out / "run.mcap").attachments, str(out))
    assert truth is not None  # every data set here has it
    return figures, read_trajectory(out / "trajectory.txt"), truth


def promises(*of: tuple[str, bool]) -> str:
    """A line for each promise: its text, and whether it was met."""
    return "\n" + "\n".join(f"{'met: ' if met else 'NOT MET: '}{what}" for what, met in of)


# --- drift around a loop ------------------------------------------------------------------------------------------------------------------


def measure_loop(folder: Path, _: Sequences, overrides: Sequence[str]) -> Rows:
    """One row for each loop closer."""
    rows = []
    for loop in LOOPS:
        words = ["dataset=synthetic", "dataset.scene=corridor", *overrides, f"loop={loop}"]
        figures, estimate, truth = _run(folder / loop, words)
        path_m, drift_m = end_drift(estimate, truth)
        final = figures["metrics"]["final"]
        rows.append({"loop": loop, "frames": figures["frames"], "path_m": path_m, "drift_m": drift_m})
        rows[-1] |= {"drift_percent": 100.0 * drift_m / path_m, "ate_m": final["ate_rmse_m"], "tracked_share": final["tracked_share"]}
    return rows


def end_drift(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Length of the true path and error of the motion from its first to its last pose, metres. The whole path must be tracked."""
    pairs = associate(estimate.stamps_ns, truth.stamps_ns)
    poses, true = estimate.poses[pairs[:, 0]], truth.poses[pairs[:, 1]]
    ends = np.array([0]), np.array([len(pairs) - 1])
    return float(np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1).sum()), float(relative_errors(poses, true, *ends)[0][0])


def report_loop(rows: Rows) -> str:
    """The table of the corridor."""
    numbers = [(row["tracked_share"], 1e3 * row["drift_m"], row["drift_percent"], row["ate_m"]) for row in rows]
    cells = [(row["loop"], row["frames"], *"{:.3f} {:.1f} {:.4f} {:.4f}".format(*some).split()) for row, some in zip(rows, numbers)]
    head = ("loop", "frames", "tracked", "drift mm", "% of the path", "ATE m")
    of = []
    for row in rows:
        limit = DRIFT_PERCENT if row["loop"] == "none" else CLOSED_PERCENT
        met = row["tracked_share"] == 1.0 and row["drift_percent"] < limit and (row["loop"] == "none" or row["ate_m"] < ATE_M)
        of.append((f"loop={row['loop']}: a drift below {limit} % of the path" + (f", an ATE below {ATE_M} m" if limit < DRIFT_PERCENT else ""), met))
    return f"Once round a corridor, {rows[0]['path_m']:.1f} m\n" + table([head, *cells], "lrrrrr") + promises(*of)


# --- recovery of a covered camera ---------------------------------------------------------------------------------------------------------


def measure_cover(folder: Path, sequences: Sequences, overrides: Sequence[str]) -> Rows:
    """One row for each sequence."""
    rows = []
    for number, (name, (kind, options)) in enumerate(sequences.items()):
        words = ["dataset=faults", f"dataset.of={kind}", *(f"+dataset.options.{key}={value}" for key, value in options.items()), *overrides]
        words += [f"dataset.frames={ROOM_FRAMES}"] if kind == "synthetic" else []
        figures, estimate, truth = _run(folder / f"{number}_seen", words)
        poses = _poses(folder / f"{number}_seen")
        second = figures["metrics"]["final"]["rpe_second_frames"]
        first = poses[(len(poses) - second) // 2].index
        row = {"sequence": name, "frames": len(poses), "first": first, "second": second}
        row |= {"ate_m": figures["metrics"]["final"]["ate_rmse_m"], **jump(poses, estimate, truth, first, second)}
        figures, estimate, truth = _run(folder / f"{number}_covered", [*words, f"dataset.cover={first}:{first + second}"])
        poses = _poses(folder / f"{number}_covered")
        after = {"ate_m": figures["metrics"]["final"]["ate_rmse_m"], **jump(poses, estimate, truth, first, second)}
        rows.append(row | recovery(poses, first, first + second) | {f"{key}_covered": value for key, value in after.items()})
    return rows


def _poses(out: Path) -> list[Pose]:
    return [pose for pose in Recording(out / "run.mcap").values("pose") if isinstance(pose, Pose)]


def recovery(poses: Sequence[Pose], first: int, stop: int) -> dict[str, int]:
    """Count the covered frames first..stop that are lost, the frames after them until one is tracked, and the lost frames elsewhere."""
    lost = {pose.index for pose in poses if pose.status == LOST}
    back = min((pose.index for pose in poses if pose.index >= stop and pose.index not in lost), default=poses[-1].index + 1)
    return {
        "lost_covered": sum(first <= index < stop for index in lost),
        "lost_after": back - stop,
        "lost_elsewhere": sum(index < first or index > back for index in lost),
    }


def jump(poses: Sequence[Pose], estimate: Trajectory, truth: Trajectory, first: int, second: int) -> dict[str, float]:
    """Median error of the motions from the frames of the second before `first` to those of the second after the cover, as far as both are tracked;
    of less than a second where the sequence has less on either side."""
    side = min(second, first - poses[0].index, poses[-1].index + 1 - first - second)
    pairs = associate(estimate.stamps_ns, truth.stamps_ns)
    rows = {int(estimate.stamps_ns[row]): k for k, row in enumerate(pairs[:, 0])}
    stamps = {pose.index: pose.stamp_ns for pose in poses}
    ends = [[rows.get(stamps.get(index, -1), -1) for index in (k, k + second + side)] for k in range(first - side, first)]
    a, b = np.array([pair for pair in ends if min(pair) >= 0], np.int64).reshape(-1, 2).T
    if not len(a):
        return {"jump_m": float("inf"), "jump_deg": float("inf")}
    error_m, error_deg = relative_errors(estimate.poses[pairs[:, 0]], truth.poses[pairs[:, 1]], a, b)
    return {"jump_m": float(np.median(error_m)), "jump_deg": float(np.median(error_deg))}


def report_cover(rows: Rows) -> str:
    """The table of the covers."""
    head = ("sequence", "frames", "covered", "lost there", "after", "elsewhere", "jump mm", "(seen)", "jump °", "(seen)", "ATE m", "(seen)")
    cells = []
    for row in rows:
        counts = row["lost_covered"], row["lost_after"], row["lost_elsewhere"]
        errors = [row[key + end] for key in ("jump_m", "jump_deg", "ate_m") for end in ("_covered", "")]
        texts = "{:.1f} {:.1f} {:.3f} {:.3f} {:.4f} {:.4f}".format(1e3 * errors[0], 1e3 * errors[1], *errors[2:]).split()
        cells.append((row["sequence"], row["frames"], f"{row['first']}:{row['first'] + row['second']}", *counts, *texts))
    back = all(row["lost_after"] < RECOVERY and not row["lost_elsewhere"] for row in rows)
    left = all(row[f"{key}_covered"] <= max(LEFT * row[key], row[key] + LEFT_M) for row in rows for key in ("jump_m", "ate_m"))
    of = (f"tracked again within {RECOVERY} frames, and lost nowhere else", back), ("no jump left", left)
    return "Covered for a second: frames that are lost, and what is left of it\n" + table([head, *cells], "l" + "r" * 11) + promises(*of)


# --- growth on a long walk ----------------------------------------------------------------------------------------------------------------


def measure_growth(folder: Path, _: Sequences, overrides: Sequence[str]) -> Rows:
    """One row for each quantity, with its value at both ends of SPAN; the map's with the floor it covers."""
    out = folder / "growth"
    truth = _run(out, ["dataset=synthetic", "dataset.scene=rooms", f"dataset.frames={WALK}", *overrides])[2]
    timing = [timing_of(data) for _, data in Recording(out / "run.mcap").messages(TIMING_TOPIC)]
    frames = np.array([row["index"] for row in timing])
    features = np.array([sum(row["stage_ms"].get(name, 0.0) for name in FEATURES) for row in timing])
    others = np.array([sum(row["stage_ms"].values()) - row["stage_ms"]["dataset"] for row in timing]) - features
    versions = [map for map in Recording(out / "run.mcap").values("map") if isinstance(map, Map)]
    newest = np.searchsorted([map.index for map in versions], frames, side="right") - 1
    memory, map_mb = np.array([row["memory_mb"] for row in timing]), np.array([bytes_of(map) / 1e6 for map in versions])[newest]
    quantities = {
        TIME: np.array([row["frame_ms"] for row in timing]),
        "stages after the features, ms": others,
        MULTIPLE: others / features,
        "memory, MB": memory,
        "map, MB": map_mb,
        OWN: memory - map_mb,
    }
    rows: Rows = [{"quantity": name, "values": line(frames, values)} for name, values in quantities.items()]
    floor = [floor_m2(versions[newest[np.searchsorted(frames, frame)]], truth.poses[0, :3, :3]) for frame in SPAN]
    return [*rows, {"quantity": "floor with landmarks, m²", "values": floor}]


def line(frames: NDArray[np.int64], values: F64) -> list[float]:
    """Values at both ends of SPAN by the straight line of Theil and Sen through those between."""
    from scipy.stats import theilslopes

    inside = (frames >= SPAN[0]) & (frames <= SPAN[1])
    slope, offset, *_ = theilslopes(values[inside], frames[inside])
    return [float(offset + slope * frame) for frame in SPAN]


def bytes_of(map: Map) -> int:
    """Bytes of the rows of a map's tables, without freed ones."""
    return sum(table.nbytes for table in vars(map).values() if isinstance(table, Table))


def floor_m2(map: Map, R_room_world: F64) -> float:
    """Area of the squares of floor, CELL_M wide, that living points or planes of the map lie over; z of the room is up."""
    samples = map.planes.column("samples_m")[map.planes.column("alive")].reshape(-1, 3)
    places = np.concatenate([map.points.column("position_m")[map.points.column("alive")], samples[np.isfinite(samples[:, 0])]])
    return CELL_M**2 * len(np.unique(np.floor(places @ R_room_world.T[:, :2] / CELL_M), axis=0))


def report_growth(rows: Rows) -> str:
    """The table of the long walk."""
    values = {row["quantity"]: row["values"] for row in rows}
    cells = [(name, f"{a:.2f}", f"{b:.2f}", f"{100.0 * (b / a - 1.0):+.1f} %") for name, (a, b) in values.items()]
    new = np.diff(values["floor with landmarks, m²"])[0]
    memory, own = np.diff(values["memory, MB"])[0], np.diff(values["map, MB"])[0]
    last = f"Per new square metre of floor: {memory / new:.2f} MB of memory, {own / new:.2f} MB of it the map"
    of = [(f"less than {100.0 * GROWTH:.0f} % growth: {name}", values[name][1] < (1.0 + GROWTH) * values[name][0]) for name in BOUNDED]
    return "A walk through ten rooms\n" + table([("", *(f"frame {frame}" for frame in SPAN), "growth"), *cells], "lrrr") + "\n" + last + promises(*of)


PARTS: dict[str, tuple[Callable[[Path, Sequences, Sequence[str]], Rows], Callable[[Rows], str]]] = {
    "loop": (measure_loop, report_loop),
    "cover": (measure_cover, report_cover),
    "growth": (measure_growth, report_growth),
}
