"""A mesh made of planes

Reconstruct the room as polygons. A plane keeps its number, its kind and its equation.
"""

import sys
from collections import Counter
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import trihedron as th


def main(out: Path) -> None:
    """Draw the mesh, one colour for each plane, and print its size."""
    dataset = th.dataset.synthetic(width=320, height=240, length=60)
    with th.Slam(dataset(0).camera, surface="planar_polygon", outputs=["trajectory", "surface"]) as slam:
        for i in range(len(dataset)):
            frame = dataset(i)
            slam.track(frame.color, frame.depth_m, frame.stamp_ns / 1e9)
        mesh = slam.mesh()

    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    x, y, z = mesh.vertices_m.T
    for number in np.unique(mesh.instances):
        axes.plot_trisurf(x, z, -y, triangles=mesh.triangles[mesh.instances == number], alpha=0.7, shade=False)
    axes.set_box_aspect([np.ptp(x), np.ptp(z), np.ptp(y)])
    axes.view_init(elev=35, azim=-110)
    figure.savefig(out, dpi=90)
    print(f"{len(mesh.triangles)} triangles, {len(mesh.plane_ids)} planes: {dict(Counter(mesh.kinds.tolist()))} by the number of their kind")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "mesh.jpg"))
