"""The built-in synthetic room: exact truth, textured or bare, with or without a sensor's noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trihedron.datasets.motion import Motion, camera_pose
from trihedron.datasets.noise import kinect_depth, noisy_color
from trihedron.datasets.raytracing import Geometry, geometry_of
from trihedron.datasets.room import all_faces, furnished_room
from trihedron.datasets.sequence import clip_range
from trihedron.datasets.shading import Atlas, render
from trihedron.datasets.textures import bake
from trihedron.pipeline.registry import register
from trihedron.pipeline.slots import frame_range
from trihedron.pipeline.types import EXACT_DEPTH, Camera, DepthNoise, Frame, Trajectory

FOCAL_PER_WIDTH = 525.0 / 640.0  # a Kinect's nominal colour camera


@register("dataset", "synthetic")
@dataclass(frozen=True)
class Synthetic:
    """A furnished room of 5 × 4 × 2.7 m, ray traced when a frame is asked for. Frame i depends on the fields and i alone."""

    frames: str = ""  # part to make, half open: A:B, A:, :B; empty = all
    length: int = 150  # frames
    fps: float = 30.0
    seed: int = 0  # of textures, path and noise
    texture: bool = True  # false = plain surfaces: edges, but hardly a corner
    noise: bool = True  # a Kinect's depth and image noise; false = exact
    width: int = 640
    height: int = 480
    motion: Motion = Motion.walk  # walk | still | pan
    slanted: bool = False  # turns two of the walls by about 10°

    def __post_init__(self) -> None:
        frame_range(self.frames)
        for name in ("length", "fps"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: {getattr(self, name)} is not positive")
        for name in ("width", "height"):
            if not 16 <= getattr(self, name) <= 8192:
                raise ValueError(f"{name}: {getattr(self, name)} is not within 16 … 8192")
        if self.seed < 0:
            raise ValueError(f"seed: {self.seed} is negative")

    def __len__(self) -> int:
        first, stop = self._range
        return stop - first

    def __call__(self, index: int) -> Frame | None:
        """Frame `index` of the selection."""
        number = self._range[0] + index
        geometry, atlas = self._scene
        color, exact, _, cosine = render(geometry, atlas, self._camera, camera_pose(self.motion, self.seed, number / self.fps))
        depth = exact.astype(np.float32)
        if self.noise:
            rng = np.random.default_rng([self.seed, 3, number])
            depth = kinect_depth(exact, cosine, self._camera.fx, self._camera.depth_noise, rng)
            color = noisy_color(color, rng)
        return Frame(number, self._stamp_ns(number), color, depth, self._camera)

    def truth(self) -> Trajectory | None:
        """The exact pose of every frame 0 … length - 1 in the room's frame (corner of the floor, z up)."""
        poses = [camera_pose(self.motion, self.seed, number / self.fps) for number in range(self.length)]
        return Trajectory(np.array([self._stamp_ns(number) for number in range(self.length)], dtype=np.int64), np.array(poses))

    def _stamp_ns(self, number: int) -> int:
        return round(number * 1e9 / self.fps)

    @cached_property
    def _range(self) -> tuple[int, int]:
        return clip_range(self.frames, self.length, "the synthetic room (dataset.length)")

    @cached_property
    def _camera(self) -> Camera:
        focal = FOCAL_PER_WIDTH * self.width
        noise = DepthNoise() if self.noise else EXACT_DEPTH
        return Camera(self.width, self.height, focal, focal, (self.width - 1) / 2.0, (self.height - 1) / 2.0, self.fps, noise)

    @cached_property
    def _scene(self) -> tuple[Geometry, Atlas]:
        room = furnished_room(self.slanted)
        return geometry_of(room), bake(all_faces(room), self.texture, self.seed)
