"""A tracked room: path and map from above

Track the built-in room, then read poses and map from the recording.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import trihedron as th


def main(out: Path) -> None:
    """Draw the path in the map, and print the error."""
    with tempfile.TemporaryDirectory() as folder:
        done = th.run("dataset.width=320", "dataset.height=240", "dataset.length=90", out=folder, quiet=True)
        landmarks, path = done.recording.map, done.trajectory.poses[:, :3, 3]
    points, lines = landmarks.points, landmarks.lines
    places = points.column("position_m")[points.column("alive")]

    figure = Figure(figsize=(5.5, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.scatter(places[:, 0], places[:, 2], s=2, color="0.6", label="points")
    for ends in lines.column("endpoints_m")[lines.column("alive")]:
        axes.plot(ends[:, 0], ends[:, 2], color="tab:blue", linewidth=0.8)
    axes.plot(path[:, 0], path[:, 2], color="crimson", linewidth=2, label="camera")
    axes.set(aspect="equal", xlabel="x, m", ylabel="z, m")
    axes.legend()
    figure.savefig(out, dpi=90)
    print(f"{done.metrics['status']['ok']} of {done.metrics['frames']} frames ok, ATE {1e3 * done.metrics['final']['ate_rmse_m']:.1f} mm")
    print(f"{np.count_nonzero(points.column('alive'))} points and {np.count_nonzero(lines.column('alive'))} lines")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "room.jpg"))
