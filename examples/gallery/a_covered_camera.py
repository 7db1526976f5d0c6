"""A camera that is covered for half a second

The status of a frame states whether its pose was measured. Cover the camera, and see it lost and found again.
"""

import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

import trihedron as th

COLORS = {"ok": "tab:green", "degraded": "tab:orange", "lost": "tab:red"}


def main(out: Path) -> None:
    """Draw the status and the standard deviation of each frame, and print the counts."""
    words = ("dataset=faults", "dataset.cover=30:45", "+dataset.options.length=75", "+dataset.options.width=320", "+dataset.options.height=240")
    with tempfile.TemporaryDirectory() as folder:
        done = th.run(*words, out=folder, quiet=True)
        poses = done.recording.poses
    figure = Figure(figsize=(8, 2.6), layout="constrained")
    axes = figure.subplots()
    for status, color in COLORS.items():
        of = [pose for pose in poses if pose.status == status]
        axes.scatter([p.index for p in of], [1e3 * p.covariance[:3, :3].trace() ** 0.5 for p in of], s=9, color=color, label=f"{status}: {len(of)}")
    axes.set(yscale="log", xlabel="frame", ylabel="σ of the position, mm")
    axes.legend()
    figure.savefig(out, dpi=90)
    print(", ".join(f"{name} {count}" for name, count in done.metrics["status"].items()))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "covered.jpg"))
