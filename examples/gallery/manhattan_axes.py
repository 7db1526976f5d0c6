"""Normals on the sphere, and the axes found in them

Each normal is a point of the unit sphere. In a room most lie near six places, which are the ends of three orthogonal axes: the Manhattan frame.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import trihedron as th


def main(out: Path) -> None:
    """Draw the sphere and print how far the axes are from the true ones."""
    dataset = th.dataset.synthetic()
    frame = dataset(20)
    normals, found = th.normals.integral_image()(frame), th.manhattan.mean_shift()(frame)
    directions = normals.normals.reshape(-1, 3)
    directions = directions[np.isfinite(directions[:, 0])][::20]
    true = dataset.truth().poses[20, :3, :3].T  # columns: the room's axes in the camera frame
    off_deg = np.degrees(np.arccos(np.clip(np.abs(true.T @ found.rotations[0]).max(axis=0), 0, 1)))

    figure = Figure(figsize=(8, 3.6), layout="constrained")
    left, right = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2, projection="3d")
    left.imshow(frame.color)
    left.set_axis_off()
    right.scatter(*directions.T, s=1, color="0.5")
    for axis, color in zip(found.rotations[0].T, ("tab:red", "tab:green", "tab:blue")):
        right.plot(*np.stack([-axis, axis]).T, color=color, linewidth=3)
    right.set_box_aspect((1, 1, 1))
    right.view_init(elev=-60, azim=-90)
    figure.savefig(out, dpi=90)
    print(f"the axes are {', '.join(f'{angle:.2f}°' for angle in off_deg)} from the true ones")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "axes.jpg"))
