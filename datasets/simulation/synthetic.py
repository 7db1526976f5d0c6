"""The built-in synthetic scenes: exact truth, textured or bare, with or without a sensor's noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, cached_property, lru_cache
from typing import Annotated

import numpy as np

from trihedron.datasets.readers.sequence import clip_range
from trihedron.datasets.simulation import buildings
from trihedron.datasets.simulation.buildings import Building
from trihedron.datasets.simulation.depth_noise import KINECT, STEREO, noisy_color, sensed_depth
from trihedron.datasets.simulation.flats import random_flat, whole_floor
from trihedron.datasets.simulation.furniture import curved_pieces
from trihedron.datasets.simulation.glass import look_through
from trihedron.datasets.simulation.glazed_flats import glazed_flat
from trihedron.datasets.simulation.motion import Motion, camera_pose
from trihedron.datasets.simulation.raytracing import Geometry, geometry_of
from trihedron.datasets.simulation.room import BOX, Room, all_faces, furnished_room
from trihedron.datasets.simulation.shading import Atlas, render
from trihedron.datasets.simulation.textures import bake
from trihedron.datasets.simulation.true_plan import TruePlan, plans_of
from trihedron.datasets.simulation.true_surface import TrueSurface, surface_of
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import Frames, NonNegativeInt, PositiveFloat, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import EXACT_CALIBRATION, EXACT_DEPTH, F32, F64, I32, U8, Bool, Camera, Frame, Trajectory


class Scene(Enum):
    """Scene that the camera is in: one furnished room, a corridor that ends where it began, two identical offices on a corridor, ten rooms in a
    circuit, an L-shaped flat, two rooms with slanted walls, two storeys joined by stairs, a furnished flat drawn by its number, the same with
    mirrors and glass, a floor of eight furnished rooms on a corridor with a stair to two more, two identical storeys."""

    room = "room"
    corridor = "corridor"
    offices = "offices"
    rooms = "rooms"
    flat = "flat"
    slanted_flat = "slanted_flat"
    house = "house"
    random_flat = "random_flat"
    glazed_flat = "glazed_flat"
    whole_floor = "whole_floor"
    storeys = "storeys"


class Sensor(Enum):
    """Depth camera that is simulated: structured light, or stereo."""

    kinect = "kinect"
    stereo = "stereo"


BUILDINGS: dict[Scene, Callable[[], Building]] = {Scene.corridor: buildings.corridor, Scene.offices: buildings.offices, Scene.rooms: buildings.rooms,
             Scene.flat: buildings.flat, Scene.slanted_flat: buildings.slanted_flat, Scene.house: buildings.house,
             Scene.whole_floor: whole_floor, Scene.storeys: buildings.storeys}  # fmt: skip
FLATS: dict[Scene, Callable[[int], Building]] = {Scene.random_flat: random_flat, Scene.glazed_flat: glazed_flat}
SENSORS = {Sensor.kinect: KINECT, Sensor.stereo: STEREO}
ROOM_FRAMES = 150  # of the room, whose walk never ends
FOCAL_PER_WIDTH = 525.0 / 640.0  # a Kinect's nominal colour camera


@register("dataset", "synthetic")
@dataclass(frozen=True)
class Synthetic:
    """A furnished room of 5 × 4 × 2.7 m, or a building, ray traced when a frame is asked for. Frame i depends on the fields and i alone."""

    frames: Frames = ""  # part to make, half open: A:B, A:, :B, every S-th A:B:S; empty = all
    scene: Scene = Scene.room  # room | corridor | offices | rooms | flat | slanted_flat | house | random_flat | glazed_flat | whole_floor | storeys
    length: NonNegativeInt = 0  # frames; 0 = the scene's own: 150 of the room, once round a building (a longer walk goes on)
    fps: PositiveFloat = 30.0
    seed: NonNegativeInt = 0  # of textures, path and noise
    texture: bool = True  # false = plain surfaces: edges, but hardly a corner
    noise: bool = True  # the sensor's depth and image noise; false = exact
    sensor: Sensor = Sensor.kinect  # kinect | stereo
    width: Annotated[int, Range(16, 8192)] = 640
    height: Annotated[int, Range(16, 8192)] = 480
    motion: Motion = Motion.walk  # walk | fast | still | pan; in a building only walk
    slanted: bool = False  # turns two of the room's walls by about 10°
    curved: bool = False  # adds a column, a ball and a plant to the room
    flat: NonNegativeInt = 0  # number of a random_flat or glazed_flat

    def __post_init__(self) -> None:
        if self.scene is not Scene.room and self.motion is not Motion.walk:
            raise ValueError(f"motion: {self.motion.name} is for the room, a building is walked through")
        if self.scene is not Scene.room and self.slanted:
            raise ValueError("slanted: only the room has slanted walls")
        if self.scene is not Scene.room and self.curved:
            raise ValueError("curved: only the room has these pieces")

        if self.scene not in FLATS and self.flat:
            raise ValueError("flat: only scene=random_flat and scene=glazed_flat have a number")

    def __len__(self) -> int:
        return len(self._range)

    def __call__(self, index: int) -> Frame | None:
        """Frame `index` of the selection."""
        number = self._range[index]
        geometry, atlas = self._scene
        color, exact, _, cosine = render(geometry, atlas, self._camera, self._pose(number))
        panes = self._room.panes
        lost = look_through(panes, geometry, atlas, self._camera, self._pose(number), color, exact, cosine) if panes else None
        depth = exact.astype(np.float32)
        if self.noise:
            rng = np.random.default_rng([self.seed, 3, number])
            depth = sensed_depth(exact, cosine, self._camera.fx, SENSORS[self.sensor], rng)
            color = noisy_color(color, rng)
        if lost is not None:
            depth[lost] = 0.0
        return Frame(number, self._stamp_ns(number), color, depth, self._camera)

    def truth(self) -> Trajectory | None:
        """The exact pose of every frame 0 … length - 1 in the scene's frame (corner of the floor, z up)."""
        numbers = range(self._length)
        return Trajectory(np.array([self._stamp_ns(number) for number in numbers], dtype=np.int64), np.array([self._pose(n) for n in numbers]))

    def surface(self) -> TrueSurface:
        """The exact surface of the scene, in the frame of `truth`."""
        return surface_of(self._room)

    def plans(self) -> list[TruePlan]:
        """The exact plan of each storey of the scene, in the frame of `truth`."""
        return plans_of(self._room)

    def true_view(self, index: int) -> tuple[F64, Bool]:
        """(h, w) exact depth in metres of frame `index` of the selection, and (h, w) whether what is seen there is curved."""
        geometry, atlas = self._scene
        _, depth, faces, _ = render(geometry, atlas, self._camera, self._pose(self._range[index]))
        return depth, np.array([face.curved != BOX for face in all_faces(self._room)])[faces]

    def true_planes(self, index: int) -> tuple[F64, I32, F64]:
        """(h, w) exact depth in metres of frame `index` of the selection, (h, w) the plane that each pixel shows, -1 where it is curved, and (k, 4)
        these planes in the camera frame, `d >= 0`. Faces that are coplanar are one plane."""
        geometry, atlas = self._scene
        T_world_camera = self._pose(self._range[index])
        _, depth, faces, _ = render(geometry, atlas, self._camera, T_world_camera)
        known = all_faces(self._room)
        world = np.array([[*face.normal, matmul(-face.normal, face.origin)] for face in known])
        planes, number = np.unique(np.round(world, 6), axis=0, return_inverse=True)
        number = np.where([face.curved == BOX for face in known], number.reshape(-1), -1).astype(np.int32)
        local = matmul(planes, T_world_camera)  # n·(R p + t) + d
        return depth, number[faces].astype(np.int32), np.asarray(np.where(local[:, 3:] < 0.0, -local, local), np.float64)

    def true_pose(self, index: int) -> F64:
        """(4, 4) exact `T_world_camera` of frame `index` of the selection, in the frame of `truth`."""
        return self._pose(self._range[index])

    def pose_at(self, time_s: float) -> F64:
        """(4, 4) exact `T_world_camera` at a time in seconds; frame i is at i / fps."""
        if self._building is not None:
            return self._building.walk.pose(self.seed, time_s)
        return camera_pose(self.motion, self.seed, time_s)

    def seen_by(self, camera: Camera, T_world_camera: F64) -> tuple[U8, F64, I32, F32]:
        """Render the scene without noise by any camera at any pose: what `shading.render` returns."""
        return render(*self._scene, camera, T_world_camera)

    def _pose(self, number: int) -> F64:
        """(4, 4) `T_world_camera` of a frame."""
        return self.pose_at(number / self.fps)

    def _stamp_ns(self, number: int) -> int:
        return round(number * 1e9 / self.fps)

    @cached_property
    def _building(self) -> Building | None:
        return _building_of(self.scene, self.flat)

    @cached_property
    def _length(self) -> int:
        natural = ROOM_FRAMES if self._building is None else round(self._building.walk.duration_s * self.fps)
        return self.length or natural

    @cached_property
    def _range(self) -> range:
        return clip_range(self.frames, self._length, f"the synthetic {self.scene.name} (dataset.length)")

    @cached_property
    def _camera(self) -> Camera:
        focal = FOCAL_PER_WIDTH * self.width
        noise = SENSORS[self.sensor].noise if self.noise else EXACT_DEPTH
        return Camera(self.width, self.height, focal, focal, (self.width - 1) / 2.0, (self.height - 1) / 2.0, self.fps, noise, EXACT_CALIBRATION)

    @cached_property
    def _scene(self) -> tuple[Geometry, Atlas]:
        return _paint_scene(self.scene, self.flat, self.slanted, self.curved, self.texture, self.seed)

    @cached_property
    def _room(self) -> Room:
        return _room_of(self.scene, self.flat, self.slanted, self.curved)


@cache
def _building_of(scene: Scene, flat: int) -> Building | None:
    return FLATS[scene](flat) if scene in FLATS else BUILDINGS[scene]() if scene in BUILDINGS else None


@cache
def _room_of(scene: Scene, flat: int, slanted: bool, curved: bool) -> Room:
    if (building := _building_of(scene, flat)) is not None:
        return building.room
    room = furnished_room(slanted)
    return replace(room, solids=(*room.solids, *curved_pieces())) if curved else room


@lru_cache(maxsize=2)
def _paint_scene(scene: Scene, flat: int, slanted: bool, curved: bool, texture: bool, seed: int) -> tuple[Geometry, Atlas]:
    """Shapes and textures of a scene: to paint them takes as long as a hundred small frames, and runs of one process share them."""
    room = _room_of(scene, flat, slanted, curved)
    return geometry_of(room), bake(all_faces(room), texture, seed, room.detail)
