"""The camera of the Python API: intrinsics, the unit of depth images, and lens distortion."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from trihedron.datasets.readers.cameras import Calibration, calibration_fault, read_camera_file
from trihedron.datasets.readers.registration import DepthCamera
from trihedron.pipeline.core import types
from trihedron.pipeline.core.errors import DataError


@dataclass(frozen=True)
class Camera(types.Camera):
    """A pinhole camera whose colour and depth images are registered, pixel by pixel.

    Args:
        width: of both images, px.
        height: of both images, px.
        fx: focal length along x, px.
        fy: focal length along y, px; positive.
        cx: principal point, px; the centre of the first pixel is at 0.
        cy: principal point, px.
        fps: nominal frames per second.
        depth_noise: standard deviation of a depth reading; that of a Kinect by default.
        sigmas: standard deviations with which the calibration is known, `trihedron.CalibrationSigmas`; those of a camera of a kind by default.
        depth_scale: value of a 16-bit depth image per metre, 1000 for millimetres; 0 where depth is given in metres.
        distortion: k1 k2 p1 p2 k3 of Brown's model, in OpenCV's order, of both images; empty for undistorted ones.
        depth_offset: added to inverse depths (1/m).
        depth_radial: relative error of depth in the corners of the image; it grows with the squared distance from the centre.
        depth_camera: the separate camera of depth images that are not registered to colour.
        readout_s: seconds from the first row of colour to the last, of a rolling shutter; negative where the last is read first.
        depth_readout_s: the same of depth.
        depth_delay_s: seconds by which depth is taken after colour.

    Raises:
        DataError: a number is one that no camera has, as a width of 0.

    Examples:
        >>> import numpy as np
        >>> import trihedron as th
        >>> camera = th.Camera(640, 480, 525.0, 525.0, 319.5, 239.5, depth_scale=1000)
        >>> camera.project(np.array([[0.1, 0.0, 2.0]])).tolist()
        [[345.75, 239.5]]
        >>> camera.back_project(np.array([[319.5, 239.5]]), np.array([2.0])).tolist()
        [[0.0, 0.0, 2.0]]
    """

    depth_scale: float = 0.0
    distortion: tuple[float, ...] = ()
    depth_offset: float = 0.0
    depth_radial: float = 0.0
    depth_camera: DepthCamera | None = None
    readout_s: float = 0.0
    depth_readout_s: float = 0.0
    depth_delay_s: float = 0.0

    def __post_init__(self) -> None:
        if fault := calibration_fault(self.calibration):
            raise DataError("camera", fault, "give the numbers of a calibration, in pixels and seconds")

    @classmethod
    def from_yaml(cls, path: str | Path) -> Camera:
        """Read a camera file: `width height fx fy cx cy depth_scale [distortion] [fps] [depth_noise] [depth_offset]
        [depth_radial] [depth_camera] [readout_s] [depth_readout_s] [depth_delay_s] [sigmas]`.

        Args:
            path: the file, one `key: value` a line; ~ is the home folder.

        Returns:
            The camera; without distortion and with 30 frames per second where the file gives none.

        Raises:
            DataError: the file cannot be read, or a key is missing, unknown or of no use; it names file and key.

        Examples:
            >>> from pathlib import Path
            >>> import trihedron as th
            >>> keys = {"width": 160, "height": 120, "fx": 131.25, "fy": 131.25, "cx": 79.5, "cy": 59.5, "depth_scale": 5000}
            >>> _ = Path("camera.yaml").write_text("".join(f"{key}: {value}\\n" for key, value in keys.items()))
            >>> th.Camera.from_yaml("camera.yaml").depth_scale
            5000.0
        """
        return cls.of(read_camera_file(Path(path).expanduser()))

    @classmethod
    def of(cls, camera: object) -> Camera:
        """Make a camera of a frame's, or of a data set's calibration.

        Args:
            camera: a `Camera` is returned as it is; that of a frame has no distortion, and depth in metres.

        Returns:
            A camera with the same intrinsics.

        Raises:
            DataError: it is neither.
        """
        if not isinstance(camera, (types.Camera, Calibration)):
            cure = 'give trihedron.Camera.from_yaml("camera.yaml"), or trihedron.Camera(width, height, fx, fy, cx, cy)'
            raise DataError("camera", f"is {type(camera).__name__}, not a camera", cure)
        if isinstance(camera, cls):
            return camera
        pinhole = camera.camera if isinstance(camera, Calibration) else camera
        values = {field.name: getattr(pinhole, field.name) for field in fields(types.Camera)}
        if isinstance(camera, Calibration):
            more = {field.name: getattr(camera, field.name) for field in fields(Calibration) if field.name != "camera"}
            return cls(**values, **more)
        return cls(**values)

    @property
    def calibration(self) -> Calibration:
        """The camera as the readers of data sets have it."""
        pinhole = types.Camera(**{field.name: getattr(self, field.name) for field in fields(types.Camera)})
        own = {field.name: getattr(self, field.name) for field in fields(Calibration) if field.name != "camera"}
        return Calibration(**own | {"camera": pinhole, "distortion": tuple(self.distortion)})
