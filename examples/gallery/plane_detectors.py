"""Four plane detectors on one image

A slot's plugins have the same inputs and the same output, so that a loop over their names compares them.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import trihedron as th

DETECTORS = ("connected_components", "ahc", "cape", "ransac")


def main(out: Path) -> None:
    """Draw what each one finds, and print the share of the image that it covers."""
    frame = th.dataset.synthetic(curved=True)(40)
    normals = th.normals.integral_image()(frame)
    figure = Figure(figsize=(9, 2.2), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(DETECTORS)), DETECTORS):
        planes = getattr(th.planes, name)()(frame, normals)
        labels = np.ma.masked_equal(np.kron(planes.labels, np.ones((planes.stride, planes.stride))), 0)
        axes.imshow(frame.color, alpha=0.6)
        axes.imshow(labels, cmap="tab20", alpha=0.7, interpolation="nearest")
        axes.set_title(name, fontsize=9)
        axes.set_axis_off()
        print(f"{name}: {len(planes.pixels)} planes cover {100 * planes.pixels.sum() / frame.depth_m.size:.0f} % of the image")
    figure.savefig(out, dpi=90)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "planes.jpg"))
