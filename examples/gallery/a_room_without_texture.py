"""A room without texture

Plain walls have edges and planes, but hardly a corner. Compare the default graph with one that uses points alone.
"""

import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

import trihedron as th


def main(out: Path) -> None:
    """Draw both paths, and print what was tracked."""
    words = ("dataset.texture=false", "dataset.width=320", "dataset.height=240", "dataset.length=60")
    frame = th.dataset.synthetic(texture=False, width=320, height=240)(0)
    figure = Figure(figsize=(9, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.imshow(frame.color)
    left.set_axis_off()
    for graph in ("structural", "points"):
        with tempfile.TemporaryDirectory() as folder:
            done = th.run(*words, graph=graph, out=folder, quiet=True)
            path = done.trajectory.poses[:, :3, 3]
        right.plot(path[:, 0], path[:, 2], label=f"graph={graph}")
        final = done.metrics["final"] or {}
        print(f"graph={graph}: {100 * final.get('tracked_share', 0):.0f} % tracked, ATE {1e3 * final.get('ate_rmse_m', float('nan')):.1f} mm")
    right.set(aspect="equal", xlabel="x, m", ylabel="z, m")
    right.legend()
    figure.savefig(out, dpi=90)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "bare.jpg"))
