"""Sensors and their hidden parameters: what a camera's file does not state, drawn from ranges that are published or usual for the kind.

Ranges: Kinect v1 by Khoshelham and Elberink (2012) and the TUM benchmark (readout about 30 ms, colour and depth not synchronised); time of flight by
Sarbolandi et al. (2015: wiggling error, flying pixels, noise by amplitude); RealSense by Keselman et al. (2017: subpixel noise 0.05 to 0.15 px);
HoloLens by Hübner et al. (2020: long throw at 1 to 5 Hz); phone by Luetzenburg et al. (2021: about 1 % of the range), rolling shutters of 10 to
30 ms. Intrinsics of any one camera are known to about 0.5 %, registration to 1 to 3 px.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

import numpy as np

Interval = tuple[float, float]
STREAM = 7  # of the random numbers that draw the parameters


class Sensor(Enum):
    """Kind of the sensor: structured light, time of flight, active stereo, a slow time-of-flight camera worn on the head, a telephone's lidar."""

    kinect_v1 = "kinect_v1"
    tof = "tof"
    realsense_stereo = "realsense_stereo"
    hololens = "hololens"
    phone = "phone"


@dataclass(frozen=True)
class SensorModel:
    """Common properties of the sensors of a kind: nominal focal length in widths of the image, frame rate, and ranges of the hidden parameters."""

    focal_per_width: float
    fps: float
    readout_ms: Interval  # colour, first row to last
    depth_readout_ms: Interval
    delay_ms: Interval  # from colour to depth
    exposure_ms: Interval
    jpeg_quality: tuple[int, int]  # 0: lossless
    radial_bias: Interval  # relative error of depth in the corners of the image
    inverse_depth_offset_per_m: Interval
    noise: Interval  # times the kind's usual standard deviation


MODELS = {
    Sensor.kinect_v1: SensorModel(525 / 640, 30.0, (20, 32), (20, 32), (-20, 20), (4, 25), (0, 0), (-0.01, 0.02), (-0.004, 0.004), (0.8, 1.3)),
    Sensor.tof: SensorModel(580 / 640, 30.0, (15, 30), (0, 0), (-10, 15), (4, 20), (85, 95), (-0.008, 0.008), (-0.001, 0.001), (0.8, 1.4)),
    Sensor.realsense_stereo: SensorModel(610 / 640, 30.0, (10, 25), (0, 0), (-16, 16), (3, 20), (0, 0), (-0.015, 0.015), (-0.004, 0.004), (0.7, 1.4)),
    Sensor.hololens: SensorModel(590 / 640, 5.0, (8, 16), (0, 0), (-30, 30), (3, 12), (60, 85), (-0.01, 0.01), (-0.001, 0.001), (0.8, 1.4)),
    Sensor.phone: SensorModel(500 / 640, 30.0, (10, 30), (0, 0), (-3, 8), (4, 16), (70, 92), (-0.005, 0.005), (-0.001, 0.001), (0.8, 1.3)),
}
FOCAL_ERROR, CENTER_ERROR_PX, MISREGISTRATION_PX = 0.005, 2.0, (1.0, 3.0)  # px at 640 a line
GAIN_STRENGTH = (0.3, 1.0)  # of the automatic exposure: 1 keeps the mean brightness


@dataclass(frozen=True)
class SensorParameters:
    """Hidden parameters of one sensor: the truth that `calibrate` should find. Pixels are of an image 640 wide.

    `focal_factor` (fx, fy) and `center_px` turn the stated intrinsics into those of the colour image, `depth_focal_factor` and `misregistration_px`
    those of colour into those of depth. A reading is `z (1 + radial_bias r²) ` with r = 1 in the corners, after `1/z -> 1/z - offset`."""

    readout_ms: float
    depth_readout_ms: float
    delay_ms: float
    exposure_ms: float
    jpeg_quality: int
    radial_bias: float
    inverse_depth_offset_per_m: float
    noise: float
    gain_strength: float
    focal_factor: tuple[float, float]
    center_px: tuple[float, float]
    depth_focal_factor: float
    misregistration_px: tuple[float, float]

    def to_dict(self) -> dict[str, Any]:
        """Return field name -> value, ready for JSON."""
        return asdict(self)


def drawn_parameters(sensor: Sensor, seed: int) -> SensorParameters:
    """Draw the hidden parameters of sensor number `seed` of a kind."""
    rng, model = np.random.default_rng([seed, STREAM, list(Sensor).index(sensor)]), MODELS[sensor]

    def within(interval: Interval) -> float:
        return float(rng.uniform(*interval))

    def pair(low: float, high: float) -> tuple[float, float]:
        return float(rng.uniform(low, high)), float(rng.uniform(low, high))

    length, angle = within(MISREGISTRATION_PX), within((0.0, 2.0 * np.pi))
    return SensorParameters(
        readout_ms=within(model.readout_ms),
        depth_readout_ms=within(model.depth_readout_ms),
        delay_ms=within(model.delay_ms),
        exposure_ms=within(model.exposure_ms),
        jpeg_quality=int(rng.integers(model.jpeg_quality[0], model.jpeg_quality[1] + 1)),
        radial_bias=within(model.radial_bias),
        inverse_depth_offset_per_m=within(model.inverse_depth_offset_per_m),
        noise=within(model.noise),
        gain_strength=within(GAIN_STRENGTH),
        focal_factor=pair(1.0 - FOCAL_ERROR, 1.0 + FOCAL_ERROR),
        center_px=pair(-CENTER_ERROR_PX, CENTER_ERROR_PX),
        depth_focal_factor=within((1.0 - FOCAL_ERROR, 1.0 + FOCAL_ERROR)),
        misregistration_px=(float(length * np.cos(angle)), float(length * np.sin(angle))),
    )
