"""Track a camera frame by frame, and save what was found.

python examples/camera_loop.py [FOLDER]    # a folder of images as of `dataset=folder`; without one the built-in room
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import trihedron as th


def frames(dataset: Any) -> Iterator[tuple[Any, Any, float]]:
    """Stand in for your camera: RGB, depth in metres, seconds."""
    for i in range(len(dataset)):
        if (frame := dataset(i)) is not None:
            yield frame.color, frame.depth_m, frame.stamp_ns / 1e9


def main(folder: str = "", out: str = ".", length: int = 60, width: int = 640, height: int = 480) -> None:
    dataset = th.dataset.folder(path=folder) if folder else th.dataset.synthetic(length=length, width=width, height=height)
    with th.Slam(dataset(0).camera, outputs=["trajectory", "surface"]) as slam:
        for rgb, depth, t in frames(dataset):
            pose = slam.track(rgb, depth, t)
            if pose.index % 10 == 0:
                x, y, z = pose.T_world_camera[:3, 3]
                planes = slam.values["planes"]
                print(f"{t:8.3f} s  {pose.status:8}  x {x:6.3f}  y {y:6.3f}  z {z:6.3f} m  {len(planes.pixels)} planes")
        mesh = slam.mesh()
        print(f"{len(slam.map.points)} points and {len(slam.map.planes)} planes in the map, {len(mesh.triangles)} triangles")
        slam.trajectory.to_tum(f"{out}/trajectory.txt")
        slam.save_map(f"{out}/room_map.mcap")
        slam.save(f"{out}/run.mcap")


if __name__ == "__main__":
    main(*sys.argv[1:])
