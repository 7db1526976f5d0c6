"""The synthetic scenes as sensors of several kinds record them, each with hidden parameters that its stated camera does not tell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np

from trihedron.datasets.readers.sequence import clip_range
from trihedron.datasets.simulation.depth_noise import kinect_depth
from trihedron.datasets.simulation.exposure import expose_image, gain_for, motion_blurred, motion_px
from trihedron.datasets.simulation.motion import Motion
from trihedron.datasets.simulation.sensor_depth import coarse, lidar_depth, stereo_depth, tof_depth
from trihedron.datasets.simulation.sensor_models import MODELS, Sensor, SensorParameters, drawn_parameters
from trihedron.datasets.simulation.synthetic import Scene, Synthetic
from trihedron.datasets.simulation.true_surface import TrueSurface
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import Frames, NonNegativeFloat, NonNegativeInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, F64, U8, Camera, DepthNoise, Frame, Trajectory

BAND_ROWS = 8  # of a rolling shutter, rendered at one pose
METER_PX, METER_LAG_S = (40, 30), 0.15  # image by which the automatic exposure is set, and its age
COARSE_PX = 2  # pixels of colour a side for one of a HoloLens's depth


@register("dataset", "simulated_sensor")
@dataclass(frozen=True)
class SimulatedSensor:
    """A synthetic scene by a sensor of a kind: its rolling shutter, its delay between colour and depth, exposure, compression, and errors of depth,
    registration and intrinsics. The stated camera has the kind's nominal intrinsics and a Kinect's depth noise, as a folder without calibration has.
    Stamps and truth are of the middle row of colour. Frame i depends on the fields and i alone."""

    frames: Frames = ""  # part to make, half open: A:B, A:, :B, every S-th A:B:S; empty = all
    sensor: Sensor = Sensor.kinect_v1  # kinect_v1 | tof | realsense_stereo | hololens | phone
    sensor_seed: NonNegativeInt = 0  # of the hidden parameters
    scene: Scene = Scene.room  # room | corridor | offices | rooms | flat | slanted_flat
    length: NonNegativeInt = 0  # frames; 0 = 150
    fps: NonNegativeFloat = 0.0  # 0 = the sensor's own
    seed: NonNegativeInt = 0  # of textures, path and noise
    texture: bool = True  # false = plain surfaces
    width: Annotated[int, Range(64, 8192)] = 640
    height: Annotated[int, Range(48, 8192)] = 480
    motion: Motion = Motion.walk  # walk | fast | still | pan; in a building only walk
    slanted: bool = False  # turns two of the room's walls by about 10°
    curved: bool = False  # adds a column, a ball and a plant to the room

    def __post_init__(self) -> None:
        _ = self._world  # whose options are refused now

    def __len__(self) -> int:
        return len(self._range)

    def __call__(self, index: int) -> Frame | None:
        """Frame `index` of the selection."""
        number = self._range[index]
        time_s, rng = number / self._rate, np.random.default_rng([self.seed, self.sensor_seed, 8, number])
        color, depth = self._color(time_s, rng), self._depth(time_s, rng)
        return Frame(number, self._stamp_ns(number), color, depth, self.camera)

    def truth(self) -> Trajectory | None:
        """The exact pose of every frame in the scene's frame (corner of the floor, z up)."""
        numbers = range(self._length)
        stamps = np.array([self._stamp_ns(number) for number in numbers], np.int64)
        return Trajectory(stamps, np.array([self._world.pose_at(number / self._rate) for number in numbers]))

    def surface(self) -> TrueSurface:
        """The exact surface of the scene, in the frame of `truth`."""
        return self._world.surface()

    @cached_property
    def hidden(self) -> SensorParameters:
        """The parameters that the stated camera does not tell."""
        return drawn_parameters(self.sensor, self.sensor_seed)

    @cached_property
    def camera(self) -> Camera:
        """The stated camera: nominal for the kind."""
        focal = MODELS[self.sensor].focal_per_width * self.width
        return Camera(self.width, self.height, focal, focal, (self.width - 1) / 2.0, (self.height - 1) / 2.0, self._rate, DepthNoise())

    @cached_property
    def color_camera(self) -> Camera:
        """The true camera of the colour images."""
        c, px, hidden = self.camera, self.width / 640.0, self.hidden
        (kx, ky), (dx, dy) = hidden.focal_factor, hidden.center_px
        return replace(c, fx=c.fx * kx, fy=c.fy * ky, cx=c.cx + dx * px, cy=c.cy + dy * px)

    @cached_property
    def depth_camera(self) -> Camera:
        """The true camera of the depth images, which are meant to be registered to colour."""
        c, px, (dx, dy), k = self.color_camera, self.width / 640.0, self.hidden.misregistration_px, self.hidden.depth_focal_factor
        return replace(c, fx=c.fx * k, fy=c.fy * k, cx=c.cx + dx * px, cy=c.cy + dy * px)

    def _color(self, time_s: float, rng: np.random.Generator) -> U8:
        hidden = self.hidden
        color, exact, _ = self._render_rolling_shutter(self.color_camera, time_s, hidden.readout_ms / 1e3)
        half_s = 0.5e-3 * hidden.exposure_ms
        before, after = self._world.pose_at(time_s - half_s), self._world.pose_at(time_s + half_s)
        color = motion_blurred(color, motion_px(exact, self.color_camera, before, after))
        meter = replace(self.camera, width=METER_PX[0], height=METER_PX[1], fx=self.camera.fx * METER_PX[0] / self.width,
                        fy=self.camera.fy * METER_PX[1] / self.height, cx=(METER_PX[0] - 1) / 2.0, cy=(METER_PX[1] - 1) / 2.0)  # fmt: skip
        metered, *_ = self._world.seen_by(meter, self._world.pose_at(time_s - METER_LAG_S))
        return expose_image(color, gain_for(float(metered.mean()), hidden.gain_strength), hidden.jpeg_quality, rng)

    def _depth(self, time_s: float, rng: np.random.Generator) -> F32:
        """(h, w) readings in metres: of the sensor's kind, then its systematic errors."""
        hidden, camera = self.hidden, self.depth_camera
        color, exact, cosine = self._render_rolling_shutter(camera, time_s + hidden.delay_ms / 1e3, hidden.depth_readout_ms / 1e3)
        gray = np.asarray(matmul(color, np.array([0.299, 0.587, 0.114])), np.uint8)
        if self.sensor is Sensor.kinect_v1:
            noise = camera.depth_noise
            a, b, c = (hidden.noise * k for k in (noise.a_m, noise.b, noise.c_per_m))
            scaled = DepthNoise(a, b, c, noise.floor_m)
            read = kinect_depth(exact, cosine, camera.fx, scaled, rng)
        elif self.sensor is Sensor.realsense_stereo:
            read = stereo_depth(exact, gray, camera.fx, hidden.noise, rng)
        elif self.sensor is Sensor.phone:
            read = lidar_depth(exact, time_s, hidden.noise, rng)
        else:
            read = tof_depth(exact, cosine, gray, hidden.noise, rng)
        read = coarse(read, COARSE_PX) if self.sensor is Sensor.hololens else read
        y, x = np.mgrid[: self.height, : self.width].astype(np.float32)
        radius2 = ((x - camera.cx) ** 2 + (y - camera.cy) ** 2) / ((self.width**2 + self.height**2) / 4.0)
        wrong = read * (1.0 + hidden.radial_bias * radius2) / (1.0 - hidden.inverse_depth_offset_per_m * read)
        return np.where(read > 0.0, wrong, 0.0).astype(np.float32)

    def _render_rolling_shutter(self, camera: Camera, time_s: float, readout_s: float) -> tuple[U8, F64, F32]:
        """Colour, exact depth and cosine of incidence; rows are read one after the other, the middle one on time.

        Bands of BAND_ROWS rows are rendered each at its own pose, with a row more on either side: the renderer smooths no border of its image."""
        if readout_s == 0.0:
            color, depth, _, cosine = self._world.seen_by(camera, self._world.pose_at(time_s))
            return color, depth, cosine
        color, depth = np.empty((camera.height, camera.width, 3), np.uint8), np.empty((camera.height, camera.width))
        cosine = np.empty((camera.height, camera.width), np.float32)
        for first in range(0, camera.height, BAND_ROWS):
            stop = min(first + BAND_ROWS, camera.height)
            band = replace(camera, height=stop - first + 2, cy=camera.cy - first + 1)
            late_s = readout_s * ((0.5 * (first + stop - 1) - 0.5 * (camera.height - 1)) / camera.height)
            seen, z, _, c = self._world.seen_by(band, self._world.pose_at(time_s + late_s))
            color[first:stop], depth[first:stop], cosine[first:stop] = seen[1:-1], z[1:-1], c[1:-1]
        return color, depth, cosine

    def _stamp_ns(self, number: int) -> int:
        return round(number * 1e9 / self._rate)

    @property
    def _rate(self) -> float:
        return self.fps or MODELS[self.sensor].fps

    @property
    def _length(self) -> int:
        return self.length or 150

    @cached_property
    def _world(self) -> Synthetic:
        return Synthetic(
            "", self.scene, self._length, self._rate, self.seed, self.texture, False,
            motion=self.motion, slanted=self.slanted, curved=self.curved,
        )  # fmt: skip

    @cached_property
    def _range(self) -> range:
        return clip_range(self.frames, self._length, f"the simulated {self.sensor.name} (dataset.length)")
