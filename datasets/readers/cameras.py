"""Camera files, published calibrations, and which of them belongs to a folder."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.readers.images import MAX_PIXELS
from trihedron.datasets.readers.registration import DepthCamera, Rectification
from trihedron.datasets.readers.rolling_shutter import Look, SteadyFrames
from trihedron.pipeline.core.errors import DataError, did_you_mean, printable
from trihedron.pipeline.core.files import MAX_YAML_BYTES, SHOWN, YamlError, parse_yaml, read_text
from trihedron.pipeline.core.types import EXACT_CALIBRATION, EXACT_DEPTH, CalibrationSigmas, Camera, DepthNoise
from trihedron.pipeline.core.value_checks import camera_fault

CAMERA_FILE = "camera.yaml"
REQUIRED = ("width", "height", "fx", "fy", "cx", "cy", "depth_scale")
TIMES = ("readout_s", "depth_readout_s", "depth_delay_s")
OPTIONAL = ("distortion", "fps", "depth_noise", "depth_offset", "depth_radial", "depth_camera", *TIMES, "sigmas")
SMALLEST_SCALE, LARGEST_SCALE = 1e-6, 1e9  # outside, single precision overflows
LARGEST_COEFFICIENT = 100.0  # of a distortion; those of lenses are below 10
LARGEST_RADIAL = 0.5
LEAST_LATER_NS = 1_000_000  # between the stamps of depth and colour where it matters
LONGEST_S = 0.2  # of times; a readout takes 1/30 s at most in most cameras
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
LARGEST_NOISE = 10.0  # of each coefficient: no sensor measures so badly
# of both cameras of a Kinect: the least of the 20 to 32 ms that are published (`datasets.simulation.sensor_models`), so that none is turned too far
KINECT_READOUT_S = 0.02
ROUNDED_PX = 1.0  # a camera file may hold a published calibration's numbers rounded
# of a Kinect whose two cameras are taken to be usual ones: so far those of the TUM benchmark are from 525 px and the image's centre, root mean square
USUAL_KINECT = CalibrationSigmas(focal=0.017, centre=0.013, depth_focal=0.017, registration=0.013)
SHORT = "give dataset.camera=tum_fr1, tum_fr2, tum_fr3, icl_nuim or a camera.yaml"


def stereo_noise(focal_px: float, baseline_m: float) -> DepthNoise:
    """Return the depth noise of a stereo camera whose disparities have a standard deviation of 0.1 px: `0.1 z² / (focal_px · baseline_m)` m at z m.

    Intel states 0.1 px for well textured surfaces ("Tuning depth cameras for best performance", revision 2.0, of the RealSense D415 and D435)."""
    return DepthNoise(0.0, 0.0, 0.1 / (focal_px * baseline_m), 0.001)


NOISES = {
    "kinect": DepthNoise(),
    "stereo": stereo_noise(447.0, 0.05),  # of a RealSense D435 at its best size: 848 pixels for 87°, 50 mm between its cameras
    "exact": EXACT_DEPTH,
}


@dataclass(frozen=True)
class Calibration:
    """The pinhole camera of a reader's frames, and the conversion of its files: depth file value per metre, lens distortion of both images
    (k1 k2 p1 p2 k3 of Brown's model, as OpenCV orders them; empty = none), what is added to inverse depths (1/m), the relative error of depth in the
    corners of the image, the separate camera of depth images that are not registered to colour, the readout times (s) of rolling shutters, and by how
    much depth is taken later than its stamp, or than colour where it has none (s)."""

    camera: Camera
    depth_scale: float
    distortion: tuple[float, ...] = ()
    depth_offset: float = 0.0
    depth_radial: float = 0.0
    depth_camera: DepthCamera | None = None
    readout_s: float = 0.0
    depth_readout_s: float = 0.0
    depth_delay_s: float = 0.0

    @cached_property
    def rectification(self) -> Rectification:
        """The conversion of an image by itself."""
        return Rectification(self.camera, self.distortion, self.depth_offset, self.depth_radial, self.depth_camera)

    def steady_frames(self, read: Callable[[int], Look | None], later_ns: NDArray[np.int64] | None = None) -> SteadyFrames | None:
        """Return what brings all rows of a frame to one time, None where they are. `read` returns the look of any frame; `later_ns` is by how much
        the stamp of depth of each frame is later than that of colour."""
        differ = later_ns is not None and bool((np.abs(later_ns) > LEAST_LATER_NS).any())
        if not (self.readout_s or self.depth_readout_s or self.depth_delay_s or differ):
            return None

        def depth_later_s(number: int) -> float:
            return self.depth_delay_s + (float(later_ns[number]) / 1e9 if later_ns is not None else 0.0)

        return SteadyFrames(self.camera, self.readout_s, self.depth_readout_s, read, depth_later_s)


def _kinect(fx: float, fy: float, cx: float, cy: float, *distortion: float) -> Calibration:
    return Calibration(Camera(640, 480, fx, fy, cx, cy), 5000.0, distortion, readout_s=KINECT_READOUT_S, depth_readout_s=KINECT_READOUT_S)


PRESETS = {
    # TUM RGB-D benchmark, "Intrinsic Camera Calibration of the Kinect", colour camera; its depth images are registered to colour
    "tum_fr1": _kinect(517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "tum_fr2": _kinect(520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "tum_fr3": _kinect(535.4, 539.2, 320.1, 247.6),
    # depth as the authors of the data set read it; the colour camera, which they did not calibrate, is that of a usual Kinect: OpenNI's focal length,
    # 25 mm to the right of depth (Konolige and Mihelich, "Technical description of Kinect calibration", 2012)
    "seven_scenes": Calibration(
        Camera(640, 480, 525.0, 525.0, 320.0, 240.0, sigmas=USUAL_KINECT),
        1000.0,
        depth_camera=DepthCamera(585.0, 585.0, 320.0, 240.0, (-0.025, 0.0, 0.0)),
        readout_s=KINECT_READOUT_S,
        depth_readout_s=KINECT_READOUT_S,
    ),
    # rendered by an exact camera; published with fy = -480, and the reader reflects the poses instead
    "icl_nuim": Calibration(Camera(640, 480, 481.2, 480.0, 319.5, 239.5, sigmas=EXACT_CALIBRATION), 5000.0),
}
FOLDER_NAMES = {  # how the published archives are called
    "tum_fr1": r"freiburg1|(^|[^a-z])fr1",
    "tum_fr2": r"freiburg2|(^|[^a-z])fr2",
    "tum_fr3": r"freiburg3|(^|[^a-z])fr3",
    "icl_nuim": r"(^|[^a-z])icl|living_?room_?traj|office_?traj|traj\d_frei|(^|[^a-z])(of|lr)[-_]?kt\d",
}


def choose_calibration(folder: Path, choice: str, default: str = "", readout_s: float | None = None) -> Calibration:
    """The calibration of a folder of images: `choice` (a preset's name or a camera file), else the folder's camera.yaml, else the preset
    its name speaks of, else the preset `default`; `readout_s` as `read_camera_file` takes it. Raises DataError when none fits or the file is
    wrong."""
    if choice in PRESETS:
        return PRESETS[choice]
    if choice:
        given = Path(choice).expanduser()
        if not given.exists():
            raise DataError("dataset.camera", f"'{choice}' is neither a file nor a preset", did_you_mean(choice, PRESETS))
        return read_camera_file(given / CAMERA_FILE if given.is_dir() else given, readout_s)
    if (folder / CAMERA_FILE).is_file():
        return read_camera_file(folder / CAMERA_FILE, readout_s)
    name = folder.resolve().name.lower()
    matching = (preset for preset, pattern in FOLDER_NAMES.items() if re.search(pattern, name))
    preset = next(matching, default)
    if not preset:
        raise DataError(str(folder), f"has no {CAMERA_FILE}, and its name is not that of a data set whose camera is known", SHORT)
    return PRESETS[preset]


def read_camera_file(path: Path, readout_s: float | None = None) -> Calibration:
    """Read a camera.yaml: `width height fx fy cx cy depth_scale [distortion k1 k2 p1 p2 k3] [fps]
    [depth_noise kinect|stereo|exact, or a_m b c_per_m floor_m] [depth_offset] [depth_radial]
    [depth_camera fx fy cx cy [translation_m] [rotation_deg]] [readout_s] [depth_readout_s] [depth_delay_s] [sigmas]`.
    Where it states no readout times both are `readout_s`; without it those of a Kinect where its numbers are, to a pixel, those that the TUM
    benchmark publishes for one of its cameras, else 0. Of exact depth, which was rendered, they are 0.

    Raises DataError naming file and key."""
    try:
        content = parse_yaml(read_text(path, MAX_YAML_BYTES))
    except YamlError as error:
        raise DataError(
            f"{path}:{error.line}" if error.line else str(path),
            "is not YAML" if error.__cause__ else f"holds {str(error).removeprefix('with ')}",
            "write one 'key: value' a line",
        ) from error
    if not isinstance(content, dict):
        raise DataError(str(path), "holds no keys", f"give {' '.join(REQUIRED)}, one 'key: value' a line")
    unknown = next((key for key in content if key not in REQUIRED + OPTIONAL), None)
    if unknown is not None:
        raise DataError(str(path), f"unknown key '{_printable_value(unknown)}'", did_you_mean(_printable_value(unknown), REQUIRED + OPTIONAL))
    missing = next((key for key in REQUIRED if key not in content), None)
    if missing is not None:
        raise DataError(str(path), f"the key '{missing}' is missing", f"give {' '.join(REQUIRED)}")
    return _calibration(path, content, readout_s)


def _calibration(path: Path, content: dict[str, Any], readout_s: float | None) -> Calibration:
    optional = ("fps", "depth_offset", "depth_radial", *TIMES)
    values = {key: _number(path, key, content[key]) for key in (*REQUIRED, *optional) if key in content}
    if values["fy"] < 0.0:
        raise DataError(str(path), "fy is negative (y up)", "give it positive; dataset=icl_nuim reflects the published poses itself")
    for key in ("width", "height", "fx", "fy", "depth_scale", "fps"):
        if values.get(key, 1.0) <= 0.0 or (key in ("width", "height") and values[key] % 1.0):
            raise DataError(
                str(path), f"{key} is {_printable_value(content[key])}", f"give a positive {'whole ' if key in ('width', 'height') else ''}number"
            )
    if values["width"] * values["height"] > MAX_PIXELS:
        raise DataError(str(path), "describes no camera", f"give an image of at most {MAX_PIXELS} pixels")
    noise = _depth_noise(path, content.get("depth_noise", "kinect"))
    fx, fy, cx, cy = (values[key] for key in ("fx", "fy", "cx", "cy"))
    sigmas = _sigmas(path, content.get("sigmas"))
    camera = Camera(int(values["width"]), int(values["height"]), fx, fy, cx, cy, values.get("fps", Camera.fps), noise, sigmas)
    offset, radial = values.get("depth_offset", 0.0), values.get("depth_radial", 0.0)
    if abs(radial) > LARGEST_RADIAL:
        raise DataError(
            str(path), f"depth_radial is {_printable_value(content['depth_radial'])}", f"give a relative error within ±{LARGEST_RADIAL:g}"
        )
    usual_s = 0.0 if noise == EXACT_DEPTH else readout_s if readout_s is not None else _published_readout_s(camera)
    times = (values.get(key, usual) for key, usual in zip(TIMES, (usual_s, usual_s, 0.0)))
    distortion, depth_camera = _distortion(path, content.get("distortion")), _depth_camera(path, content.get("depth_camera"))
    calibration = Calibration(camera, values["depth_scale"], distortion, offset, radial, depth_camera, *times)
    if fault := calibration_fault(calibration):
        raise DataError(str(path), fault, "give the numbers of a calibration, in pixels and seconds")
    return calibration


def _published_readout_s(camera: Camera) -> float:
    """Return the readout time of the preset that is calibrated with these numbers, 0.0 where none is. Of 7-Scenes, whose preset has two cameras, no
    calibration was published."""
    for preset in PRESETS.values():
        given, published = ((of.width, of.height, *of.intrinsics) for of in (camera, preset.camera))
        if preset.depth_camera is None and np.allclose(given, published, rtol=0.0, atol=ROUNDED_PX):
            return preset.readout_s
    return 0.0


def calibration_fault(found: Calibration) -> str:
    """Return the first number of a calibration that no camera has, with the cause; empty for none."""
    if fault := camera_fault(found.camera):
        return fault
    if found.depth_scale and not SMALLEST_SCALE <= found.depth_scale <= LARGEST_SCALE:
        return f"depth_scale is not within {SMALLEST_SCALE:g} … {LARGEST_SCALE:g}"
    if not all(abs(coefficient) <= LARGEST_COEFFICIENT for coefficient in found.distortion):
        return f"distortion holds coefficients that are not within ±{LARGEST_COEFFICIENT:g}"
    for key in TIMES:
        if not abs(getattr(found, key)) <= LONGEST_S:
            return f"{key} is not within ±{LONGEST_S:g}"
    if (depth := found.depth_camera) is not None:
        fault = camera_fault(replace(found.camera, fx=depth.fx, fy=depth.fy, cx=depth.cx, cy=depth.cy))
    return f"depth_camera.{fault}" if fault else ""


def _depth_noise(path: Path, given: Any) -> DepthNoise:
    """The noise of a sensor by name, or a mapping of some of the fields of `DepthNoise`; the others are 0, and the floor a millimetre."""
    if not isinstance(given, dict):
        if not isinstance(given, str) or given not in NOISES:
            raise DataError(str(path), f"depth_noise is '{_printable_value(given)}'", did_you_mean(_printable_value(given), NOISES))
        return NOISES[given]
    known = tuple(field.name for field in fields(DepthNoise))
    _check_keys(path, "depth_noise", given, known, "give it some of")
    numbers = {key: _number(path, f"depth_noise.{key}", value) for key, value in given.items()}
    noise = replace(EXACT_DEPTH, **numbers)
    faulty = next((key for key, value in numbers.items() if abs(value) > LARGEST_NOISE), "floor_m" if noise.floor_m <= 0.0 else "")
    if faulty:
        cure = f"give floor_m above 0 and the others within ±{LARGEST_NOISE:g}: σ is max(floor_m, a_m + b z + c_per_m z²) at z metres"
        raise DataError(str(path), f"depth_noise.{faulty} is {_printable_value(given[faulty])}", cure)
    return noise


def _sigmas(path: Path, given: Any) -> CalibrationSigmas:
    """Read a mapping of some of the fields of `CalibrationSigmas`; the others are those of a camera of a kind."""
    if given is None:
        return CalibrationSigmas()
    known = tuple(field.name for field in fields(CalibrationSigmas))
    _check_keys(path, "sigmas", given, known, "give it some of")
    return CalibrationSigmas(**{key: _number(path, f"sigmas.{key}", value) for key, value in given.items()})


def _depth_camera(path: Path, given: Any) -> DepthCamera | None:
    """A mapping fx fy cx cy [translation_m] [rotation_deg], the latter two of three numbers each."""
    if given is None:
        return None
    known = tuple(field.name for field in fields(DepthCamera))
    _check_keys(path, "depth_camera", given, known, "give it")
    missing = next((key for key in known[:4] if key not in given), None)
    if missing is not None:
        raise DataError(str(path), f"the key 'depth_camera.{missing}' is missing", f"give it {' '.join(known[:4])}")
    fx, fy, cx, cy = (_number(path, f"depth_camera.{key}", given[key]) for key in known[:4])
    return DepthCamera(fx, fy, cx, cy, *(_three(path, f"depth_camera.{key}", given.get(key)) for key in known[4:]))


def _check_keys(path: Path, name: str, given: Any, known: tuple[str, ...], cure: str) -> None:
    """Raise DataError where what is given is no mapping, or has a key that is not known."""
    if not isinstance(given, dict):
        raise DataError(str(path), f"{name} holds no keys", f"{cure} {' '.join(known)}")
    unknown = next((key for key in given if key not in known), None)
    if unknown is not None:
        raise DataError(str(path), f"unknown key '{name}.{_printable_value(unknown)}'", did_you_mean(_printable_value(unknown), known))


def _three(path: Path, key: str, given: Any) -> tuple[float, float, float]:
    """A list of three numbers; zeros where there is none."""
    if given is None:
        return 0.0, 0.0, 0.0
    if not isinstance(given, list) or len(given) != 3:
        raise DataError(str(path), f"{key} does not hold 3 numbers", "give a list [x, y, z]")
    x, y, z = (_number(path, key, value) for value in given)
    return x, y, z


def _distortion(path: Path, given: Any) -> tuple[float, ...]:
    """A mapping k1 k2 p1 p2 k3 (absent ones are 0), a list of the five, or one line of text with the five -> tuple, empty when all are zero."""
    if given is None:
        return ()
    if isinstance(given, dict):
        unknown = next((key for key in given if key not in COEFFICIENTS), None)
        if unknown is not None:
            raise DataError(str(path), f"unknown key 'distortion.{_printable_value(unknown)}'", did_you_mean(_printable_value(unknown), COEFFICIENTS))
        given = [given.get(key, 0.0) for key in COEFFICIENTS]
    if isinstance(given, str):
        given = given.replace(",", " ").split()
    if not isinstance(given, list) or len(given) != len(COEFFICIENTS):
        raise DataError(str(path), "distortion does not hold 5 numbers", "give k1 k2 p1 p2 k3 as a mapping or a list")
    values = tuple(_number(path, f"distortion.{key}", value) for key, value in zip(COEFFICIENTS, given))
    return values if any(values) else ()


def _printable_value(value: Any) -> str:
    """A value of the file in a message: one line, bounded."""
    try:
        return printable(str(value), SHOWN)
    except ValueError:  # a whole number of thousands of digits
        return "too large"


def _number(path: Path, key: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)  # text too: YAML takes 5e2 for text
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise DataError(str(path), f"{key} is '{_printable_value(value)}'", "give a finite number")
    return number


def with_noise(calibration: Calibration, exact_depth: bool) -> Calibration:
    """The calibration with the depth noise of exact depth when asked for, else unchanged."""
    return replace(calibration, camera=replace(calibration.camera, depth_noise=EXACT_DEPTH)) if exact_depth else calibration
