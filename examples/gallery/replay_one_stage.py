"""Run one stage again from a recording

Record a run once. Then compute the Manhattan frame again with another estimator; everything else is read from the file. Unchanged, the stage gives
the same bytes.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import trihedron as th


def angle_deg(R: np.ndarray) -> float:
    """The angle of a rotation, up to the order and the signs of the axes."""
    return float(np.degrees(np.arccos(np.clip(np.abs(R).max(axis=0), 0, 1)).max()))


def main(out: Path) -> None:
    """Draw how far the estimators are apart, and print whether the unchanged one gives the same."""
    with tempfile.TemporaryDirectory() as folder:
        recorded = th.run("dataset.width=320", "dataset.height=240", "dataset.length=45", out=folder, quiet=True).recording
        first = [value.rotations[0] for value in recorded.values("manhattan")]
        again = [value.rotations[0] for value in recorded.replay(only=["manhattan"]).values("manhattan")]
        other = {name: recorded.replay(only=["manhattan"], manhattan=name) for name in ("branch_and_bound", "plane_svd")}
        angles = {name: [angle_deg(a.T @ b.rotations[0]) for a, b in zip(first, found.values("manhattan"))] for name, found in other.items()}

    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.subplots()
    for name, line in angles.items():
        axes.plot(line, label=f"{name} against mean_shift")
    axes.set(xlabel="frame", ylabel="degrees")
    axes.legend(fontsize=8)
    figure.savefig(out, dpi=90)
    print(f"mean_shift again: {'bit-equal' if np.array_equal(first, again) else 'different'} in {len(again)} frames")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "replay.jpg"))
