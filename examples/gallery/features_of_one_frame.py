"""Features of one frame

Call stages alone on one image of the built-in room: key points, line segments and planes. Inputs that are missing, here the normals that planes need,
come from the default plugin of their slot.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

import trihedron as th


def main(out: Path) -> None:
    """Draw the features and print how many there are."""
    frame = th.dataset.synthetic()(20)
    points, lines, planes = th.keypoints.orb()(frame), th.lines.lsd()(frame), th.planes.connected_components()(frame)
    labels = np.ma.masked_equal(np.kron(planes.labels, np.ones((planes.stride, planes.stride))), 0)

    figure = Figure(figsize=(10, 2.8), layout="constrained")
    for axes, title in zip(figure.subplots(1, 3), ("key points", "line segments", "planes")):
        axes.imshow(frame.color, alpha=1 if title == "key points" else 0.6)
        axes.set_title(f"{title}", fontsize=9)
        axes.set_axis_off()
    figure.axes[0].scatter(*points.pixels.T, s=4, color="lime")
    for ends in lines.endpoints_px:
        figure.axes[1].plot(*ends.T, linewidth=1)
    figure.axes[2].imshow(labels, cmap=colormaps["tab20"], alpha=0.7, interpolation="nearest")
    figure.savefig(out, dpi=90)
    print(f"{len(points.pixels)} key points, {len(lines.endpoints_px)} line segments, {len(planes.pixels)} planes")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "features.jpg"))
