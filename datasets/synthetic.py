"""The built-in synthetic scenes: exact truth, textured or bare, with or without a sensor's noise."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from trihedron.datasets import buildings
from trihedron.datasets.buildings import Building
from trihedron.datasets.motion import Motion, camera_pose
from trihedron.datasets.noise import kinect_depth, noisy_color
from trihedron.datasets.raytracing import Geometry, geometry_of
from trihedron.datasets.room import Room, all_faces, furnished_room
from trihedron.datasets.sequence import clip_range
from trihedron.datasets.shading import Atlas, render
from trihedron.datasets.textures import bake
from trihedron.pipeline.registry import register
from trihedron.pipeline.slots import frame_range
from trihedron.pipeline.types import EXACT_DEPTH, F64, Camera, DepthNoise, Frame, Trajectory


class Scene(Enum):
    """Where the camera is: one furnished room, a corridor that ends where it began, two identical offices on a corridor, ten rooms in a circuit."""

    room = "room"
    corridor = "corridor"
    offices = "offices"
    rooms = "rooms"


BUILDINGS = {Scene.corridor: buildings.corridor, Scene.offices: buildings.offices, Scene.rooms: buildings.rooms}
ROOM_FRAMES = 150  # of the room, whose walk never ends
FOCAL_PER_WIDTH = 525.0 / 640.0  # a Kinect's nominal colour camera


@register("dataset", "synthetic")
@dataclass(frozen=True)
class Synthetic:
    """A furnished room of 5 × 4 × 2.7 m, or a building, ray traced when a frame is asked for. Frame i depends on the fields and i alone."""

    frames: str = ""  # part to make, half open: A:B, A:, :B; empty = all
    scene: Scene = Scene.room  # room | corridor | offices | rooms
    length: int = 0  # frames; 0 = the scene's own: 150 of the room, once round a building (a longer walk goes on)
    fps: float = 30.0
    seed: int = 0  # of textures, path and noise
    texture: bool = True  # false = plain surfaces: edges, but hardly a corner
    noise: bool = True  # a Kinect's depth and image noise; false = exact
    width: int = 640
    height: int = 480
    motion: Motion = Motion.walk  # walk | fast | still | pan; in a building only walk
    slanted: bool = False  # turns two of the room's walls by about 10°

    def __post_init__(self) -> None:
        frame_range(self.frames)
        if self.length < 0:
            raise ValueError(f"length: {self.length} is negative")
        if self.fps <= 0:
            raise ValueError(f"fps: {self.fps} is not positive")
        for name in ("width", "height"):
            if not 16 <= getattr(self, name) <= 8192:
                raise ValueError(f"{name}: {getattr(self, name)} is not within 16 … 8192")
        if self.seed < 0:
            raise ValueError(f"seed: {self.seed} is negative")
        if self.scene is not Scene.room and self.motion is not Motion.walk:
            raise ValueError(f"motion: {self.motion.name} is for the room, a building is walked through")
        if self.scene is not Scene.room and self.slanted:
            raise ValueError("slanted: only the room has slanted walls")

    def __len__(self) -> int:
        first, stop = self._range
        return stop - first

    def __call__(self, index: int) -> Frame | None:
        """Frame `index` of the selection."""
        number = self._range[0] + index
        geometry, atlas = self._scene
        color, exact, _, cosine = render(geometry, atlas, self._camera, self._pose(number))
        depth = exact.astype(np.float32)
        if self.noise:
            rng = np.random.default_rng([self.seed, 3, number])
            depth = kinect_depth(exact, cosine, self._camera.fx, self._camera.depth_noise, rng)
            color = noisy_color(color, rng)
        return Frame(number, self._stamp_ns(number), color, depth, self._camera)

    def truth(self) -> Trajectory | None:
        """The exact pose of every frame 0 … length - 1 in the scene's frame (corner of the floor, z up)."""
        numbers = range(self._length)
        return Trajectory(np.array([self._stamp_ns(number) for number in numbers], dtype=np.int64), np.array([self._pose(n) for n in numbers]))

    def _pose(self, number: int) -> F64:
        """(4, 4) `T_world_camera` of a frame."""
        if self._building is not None:
            return self._building.walk.pose(self.seed, number / self.fps)
        return camera_pose(self.motion, self.seed, number / self.fps)

    def _stamp_ns(self, number: int) -> int:
        return round(number * 1e9 / self.fps)

    @cached_property
    def _building(self) -> Building | None:
        return BUILDINGS[self.scene]() if self.scene in BUILDINGS else None

    @cached_property
    def _length(self) -> int:
        natural = ROOM_FRAMES if self._building is None else round(self._building.walk.duration_s * self.fps)
        return self.length or natural

    @cached_property
    def _range(self) -> tuple[int, int]:
        return clip_range(self.frames, self._length, f"the synthetic {self.scene.name} (dataset.length)")

    @cached_property
    def _camera(self) -> Camera:
        focal = FOCAL_PER_WIDTH * self.width
        noise = DepthNoise() if self.noise else EXACT_DEPTH
        return Camera(self.width, self.height, focal, focal, (self.width - 1) / 2.0, (self.height - 1) / 2.0, self.fps, noise)

    @cached_property
    def _scene(self) -> tuple[Geometry, Atlas]:
        room: Room = furnished_room(self.slanted) if self._building is None else self._building.room
        return geometry_of(room), bake(all_faces(room), self.texture, self.seed, room.detail)
