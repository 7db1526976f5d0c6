"""Write a plugin, try it on one image beside the default one, then track with it.

python examples/plugin_on_one_image.py
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

import trihedron as th
from trihedron.pipeline.core.options import Range


@th.register("normals", "example_central_differences")
@dataclass(frozen=True)
class CentralDifferences:
    """Smooth the points, then take the cross product of the differences between neighbours `step` pixels away."""

    step: Annotated[int, Range(1, 20)] = 5
    stride: Annotated[int, Range(1, 16)] = 2

    def __call__(self, frame: th.Frame) -> th.Normals:
        height, width = frame.depth_m.shape
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        points = frame.camera.back_project(pixels, np.where(frame.depth_m > 0, frame.depth_m, np.nan))
        points = cv2.GaussianBlur(points, (2 * self.step + 1, 2 * self.step + 1), 0)  # a box would spread missing readings
        right = np.roll(points, -self.step, axis=1) - np.roll(points, self.step, axis=1)
        down = np.roll(points, -self.step, axis=0) - np.roll(points, self.step, axis=0)
        normals = np.cross(down, right)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        normals[: self.step], normals[-self.step :] = np.nan, np.nan
        normals[:, : self.step], normals[:, -self.step :] = np.nan, np.nan
        return th.Normals(frame.index, frame.stamp_ns, normals[:: self.stride, :: self.stride].astype(np.float32), self.stride)


def main(length: int = 30) -> None:
    dataset = th.dataset.synthetic(length=length)
    frame = dataset(0)
    normals = th.normals.example_central_differences(step=6)(frame)  # by its name, as on the command line
    for name, found in (("default", th.planes.connected_components()(frame)), ("with the plugin", th.planes.connected_components()(frame, normals))):
        print(f"{name}: {len(found.pixels)} planes, {100 * found.pixels.sum() / frame.depth_m.size:.0f} % of the image")
    with th.Slam(frame.camera, normals="example_central_differences") as slam:
        for i in range(length):
            frame = dataset(i)
            pose = slam.track(frame.color, frame.depth_m, frame.stamp_ns / 1e9)
    print(f"{pose.status} after {length} frames, ATE {1e3 * slam.trajectory.errors(dataset.truth())['ate_rmse_m']:.1f} mm")


if __name__ == "__main__":
    main()
