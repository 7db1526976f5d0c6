"""Compare a trajectory with the ground truth: ATE, RPE and the share of frames tracked.

Trajectories are text files in the TUM format (stamp tx ty tz qx qy qz qw). TRUTH may also be a recording, which holds the ground truth of its
run. The share of frames tracked needs to know the frames: they come from --frames, else from the recording run.mcap beside TRAJECTORY; without
either they are taken to be those of the whole ground truth, thinned to the trajectory's rate. ICL-NUIM publishes poses with y up: --y-up.

Without a ground truth, --no-reference judges a run by the σ that its poses state, and by its own depth: images moved into later ones by the estimate,
thickness of walls that several frames saw, entropy of the map, spread of mutually orthogonal planes (Kornilova and Ferrer, 2021). Smaller is better.
Where the run has a ground truth, a second column has what its depth gives under that: a measured truth is not exact, and no more is depth.

Example: trihedron evaluate runs/latest/trajectory.txt groundtruth.txt
Example: trihedron evaluate runs/latest --no-reference
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trihedron.pipeline.core.errors import DataError, RecordingError, UsageError
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.tools.arguments import Parser

if TYPE_CHECKING:
    from trihedron.pipeline.core.types import Trajectory
    from trihedron.pipeline.run.metrics import I64

LARGEST_DIFFERENCE_MS = 1000.0
MIRRORED = 0.5  # of the rotation error: a truth that fits that much better mirrored has another handedness
ROUNDING_NS = 100_000  # stamps of other programs have 4 to 6 decimals


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises DataError for files that cannot be compared, UsageError for wrong arguments."""
    parser = Parser("evaluate", __name__)
    parser.add_argument("trajectory", metavar="TRAJECTORY", type=Path, help="the estimate; a run folder or its recording with --no-reference")
    parser.add_argument("truth", metavar="TRUTH", nargs="?", type=Path, help="the ground truth, or a recording that holds it")
    parser.add_argument("--no-reference", action="store_true", help="judge a run without ground truth")
    parser.add_argument("--json", action="store_true", help="print every figure as JSON")
    parser.add_argument("--fps", type=float, help="frames a second, for the RPE over one second (default: the recording's, else by the stamps)")
    parser.add_argument("--frames", type=Path, help="all frames of the data set: a file whose lines begin with a stamp (rgb.txt), or a recording")
    parser.add_argument("--y-up", action="store_true", help="mirror TRUTH, whose y axis points up")
    parser.add_argument("--max-difference-ms", type=float, default=20.0, help="largest time between a pose and its truth (default: 20)")
    arguments = parser.parse(argv)
    if arguments.no_reference != (arguments.truth is None):
        cause = "--no-reference takes no TRUTH" if arguments.no_reference else "the following arguments are required: TRUTH"
        raise UsageError("evaluate", cause, "see trihedron evaluate --help")
    if arguments.no_reference:
        return _without_reference(arguments.trajectory, arguments.json)
    if arguments.fps is not None and not 0.0 < arguments.fps <= 10_000.0:
        raise UsageError("evaluate", f"--fps {arguments.fps:g} is not a frame rate", "give a number above 0, for example --fps 30")
    if not 0.0 < arguments.max_difference_ms <= LARGEST_DIFFERENCE_MS:
        cause = f"--max-difference-ms {arguments.max_difference_ms:g} is out of range"
        raise UsageError("evaluate", cause, f"give a number above 0 and up to {LARGEST_DIFFERENCE_MS:g}")
    figures, mirrored_deg = evaluate_files(
        arguments.trajectory, arguments.truth, arguments.fps, arguments.frames, arguments.max_difference_ms, arguments.y_up
    )
    if mirrored_deg is not None and mirrored_deg < MIRRORED * figures["rpe_frame_rmse_deg"]:
        cause = f"its turns fit better mirrored ({mirrored_deg:.3f}° instead of {figures['rpe_frame_rmse_deg']:.3f}° between frames)"
        print(f"trihedron: warning: {arguments.truth}: {cause}; is its y axis up? give --y-up", file=sys.stderr)
    print(json.dumps(figures, indent=2) if arguments.json else report(figures))
    return 0


def _without_reference(run: Path, as_json: bool) -> int:
    from trihedron.pipeline.record.reader import Recording
    from trihedron.tools.quality import quality_of_run, quality_of_truth

    recording = Recording(run)
    figures, quality = quality_of_run(recording).to_dict(), quality_of_truth(recording)
    truth = quality.to_dict() if quality is not None else None
    columns = {"value": figures, **({"by the ground truth": truth} if truth else {})}
    if as_json:
        print(json.dumps({**figures, **({"truth": truth} if truth else {})}, indent=2))
        return 0
    rows = [["figure without truth", *columns]]
    for name in figures:
        length = name.endswith("_m")
        values = [column[name] for column in columns.values()]
        texts = ["-" if value is None else f"{1e3 * value:.2f} mm" if length else f"{value:g}" for value in values]
        rows.append([name.removesuffix("_m") if length else name, *texts])
    print(table(rows, "l" + "r" * len(columns)))
    return 0


def evaluate_files(
    trajectory: Path, truth: Path, fps: float | None, frames: Path | None, max_difference_ms: float, y_up: bool
) -> tuple[dict[str, Any], float | None]:
    """The figures of `pipeline.metrics.Metrics` for two files, and the RMSE of the rotation from frame to frame (degrees) against the truth
    mirrored once more: by it a wrong handedness is seen. Raises DataError."""
    from trihedron.datasets.readers.icl_nuim import reflect
    from trihedron.pipeline.core.types import Trajectory
    from trihedron.pipeline.record.trajectories import read_trajectory
    from trihedron.pipeline.run.metrics import evaluate_trajectory

    estimate, expected = read_trajectory(trajectory), _read_truth(truth)
    stamps, nominal_fps = read_frames(frames, estimate) if frames is not None else _frames_beside(trajectory, estimate)
    options: Any = (fps or nominal_fps, stamps, round(max_difference_ms * 1e6), (str(trajectory), str(truth)))
    mirrored = Trajectory(expected.stamps_ns, reflect(expected.poses))
    straight, turned = (evaluate_trajectory(estimate, against, *options) for against in (expected, mirrored))
    if y_up:
        straight, turned = turned, straight
    return straight.to_dict(), turned.rpe_frame_rmse_deg


def _read_truth(path: Path) -> Trajectory:
    from trihedron.pipeline.record.reader import Recording
    from trihedron.pipeline.record.trajectories import attached_truth, read_trajectory

    if path.suffix != ".mcap":
        return read_trajectory(path)
    truth = attached_truth(Recording(path).attachments, str(path))
    if truth is None:
        raise DataError(str(path), "holds no ground truth", "give the file of the ground truth")
    return truth


def _frames_beside(trajectory: Path, estimate: Trajectory) -> tuple[I64 | None, float | None]:
    """The frames of the run that wrote the trajectory, when its recording is there and its frames are those of the trajectory."""
    recording = trajectory.parent / RECORDING
    try:
        return read_frames(recording, estimate) if recording.is_file() else (None, None)
    except (DataError, RecordingError):
        return None, None


def read_frames(path: Path, estimate: Trajectory) -> tuple[I64, float | None]:
    """(n,) stamps in ns of all frames, and the camera's frame rate if it is known: the topic `frames` of a recording, or the first column of a
    text file. Stamps that differ by rounding become the estimate's. Raises DataError when the estimate has a stamp that is no frame's."""
    import numpy as np

    from trihedron.pipeline.core.types import FrameReference
    from trihedron.pipeline.record.reader import Recording
    from trihedron.pipeline.record.trajectories import parse_stamp_ns, table_lines
    from trihedron.pipeline.run.metrics import associate

    fps = None
    if path.suffix == ".mcap":
        references = [value for value in Recording(path).values("frames") if isinstance(value, FrameReference)]
        stamps, fps = [value.stamp_ns for value in references], references[0].camera.fps if references else None
    else:
        try:
            stamps = [parse_stamp_ns(words[0]) for _, words in table_lines(path)]
        except ValueError as error:
            raise DataError(str(path), str(error), "each line begins with the stamp of a frame") from error
    frames = np.unique(np.array(stamps, np.int64))
    pairs = associate(estimate.stamps_ns, frames, ROUNDING_NS)
    missing = np.delete(estimate.stamps_ns, pairs[:, 0])
    if len(missing):
        cause = f"{len(missing)} of {len(estimate)} poses have the stamp of no frame, the first is {missing[0] / 1e9:.6f} s"
        raise DataError(str(path), cause, "give the list of the frames that were tracked (rgb.txt)")
    frames[pairs[:, 1]] = estimate.stamps_ns[pairs[:, 0]]
    return frames, fps


def report(figures: dict[str, Any]) -> str:
    """The figures as a table for people."""

    def number(name: str) -> str:
        return "-" if figures[name] is None else f"{figures[name]:.6f}"

    second = figures["rpe_second_frames"]
    rows = [
        ["", "rmse", "mean", "median", "max", "pairs"],
        ["ATE (m)", *(number(f"ate_{name}_m") for name in ("rmse", "mean", "median", "max")), str(figures["poses_with_truth"])],
    ]
    for prefix, frames in (("rpe_frame", "1 frame"), ("rpe_second", f"{second} frames")):
        for unit, sign in (("m", "m"), ("deg", "°")):
            values = [number(f"{prefix}_rmse_{unit}"), "", number(f"{prefix}_median_{unit}"), "", str(figures[f"{prefix}_pairs"])]
            rows.append([f"RPE {frames} ({sign})", *values])
    of = "frames that have truth" if figures["share_basis"] == "frames" else "frames of the whole ground truth (see --frames)"
    tracked = f"tracked {figures['poses_with_truth']} of {figures['frames_with_truth']} {of}: {figures['tracked_share']:.1%}"
    span = f"{figures['tracked_share_in_span']:.1%} between the first pose and the last; {figures['poses']} poses in all"
    return "\n".join([table(rows, "lrrrrr"), tracked, span])
