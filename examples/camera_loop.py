"""Track a camera, and save the surface and the floor plan of what it saw.

python examples/camera_loop.py                      # the built-in room
python examples/camera_loop.py my_recording         # a folder with rgb/, depth/ and camera.yaml, as of `dataset=folder`
python examples/camera_loop.py realsense            # Intel RealSense: pip install 'trihedron[realsense]'
python examples/camera_loop.py oak                  # Luxonis OAK-D: pip install 'depthai>=3'

Ctrl-C ends a camera. The run folder is runs/camera, over that of the last walk, else out=FOLDER. Words after the source are those of the command
line, as view=foxglove.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, TypeAlias

import numpy as np

import trihedron as th

WIDTH, HEIGHT, FPS = 640, 480, 30
OAK_HEIGHT = 400  # with WIDTH, a size that all cameras of an OAK-D have
MAKERS = {"pyrealsense2": "pip install 'trihedron[realsense]'", "depthai": "pip install 'depthai>=3'"}  # the makers' libraries
Images: TypeAlias = Iterator[tuple[Any, Any, float]]  # RGB, registered depth, seconds
Source: TypeAlias = AbstractContextManager[tuple[Any, Images]]  # the camera, and its images for as long as it sends them


@contextmanager
def starting() -> Iterator[None]:
    """Make one line of a camera that does not start, for which the makers' libraries raise RuntimeError."""
    try:
        yield
    except RuntimeError as error:
        raise th.TrihedronError("the camera does not start", str(error), "plug it in, or try another port") from error


@contextmanager
def replay(dataset: Any) -> Iterator[tuple[Any, Images]]:
    """A data set in the place of a camera: depth in metres."""
    frames = (frame for frame in map(dataset, range(len(dataset))) if frame is not None)
    yield dataset(0).camera, ((frame.color, frame.depth_m, frame.stamp_ns / 1e9) for frame in frames)


@contextmanager
def realsense() -> Iterator[tuple[Any, Images]]:
    """A RealSense; the maker's library registers depth to colour."""
    import pyrealsense2 as rs

    config, pipeline, align = rs.config(), rs.pipeline(), rs.align(rs.stream.color)
    config.enable_stream(rs.stream.color, WIDTH, HEIGHT, rs.format.rgb8, FPS)
    config.enable_stream(rs.stream.depth, WIDTH, HEIGHT, rs.format.z16, FPS)
    with starting():
        profile = pipeline.start(config)
    intrinsics = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    scale = 1.0 / profile.get_device().first_depth_sensor().get_depth_scale()
    distortion = tuple(intrinsics.coeffs) if any(intrinsics.coeffs) else ()
    camera = th.Camera(
        intrinsics.width,
        intrinsics.height,
        intrinsics.fx,
        intrinsics.fy,
        intrinsics.ppx,
        intrinsics.ppy,
        float(FPS),
        depth_scale=scale,
        distortion=distortion,
    )

    def images() -> Images:
        while True:
            pair = align.process(pipeline.wait_for_frames())
            color, depth = pair.get_color_frame(), pair.get_depth_frame()
            if color and depth:
                yield np.asarray(color.get_data()), np.asarray(depth.get_data()), color.get_timestamp() / 1e3

    try:
        yield camera, images()
    finally:
        pipeline.stop()


@contextmanager
def oak() -> Iterator[tuple[Any, Images]]:
    """An OAK-D; the device undistorts colour and registers its stereo depth (mm) to it."""
    import depthai as dai

    with starting():
        made = dai.Pipeline()
    with made as pipeline:
        node = pipeline.create(dai.node.RGBD).build(True, size=(WIDTH, OAK_HEIGHT), fps=float(FPS))
        queue = node.rgbd.createOutputQueue(maxSize=1, blocking=False)  # the newest pair
        pipeline.start()
        (fx, _, cx), (_, fy, cy), _ = queue.get().getRGBFrame().getTransformation().getIntrinsicMatrix()

        def images() -> Images:
            while pipeline.isRunning():
                pair = queue.get()
                color, depth = pair.getRGBFrame(), pair.getDepthFrame()
                yield color.getCvFrame()[:, :, ::-1], depth.getFrame(), color.getTimestamp().total_seconds()  # OpenCV has blue first

        yield th.Camera(WIDTH, OAK_HEIGHT, fx, fy, cx, cy, float(FPS), depth_scale=1000), images()


def show(slam: Any, images: Images) -> int:
    """Track images until they or Ctrl-C end, print where the status changes, and return how many there were."""
    status, count, begin = "", 0, None
    with suppress(KeyboardInterrupt):
        for rgb, depth, t in images:
            pose = slam.track(rgb, depth, t)
            count, begin = count + 1, t if begin is None else begin
            if pose.status != status:
                status = pose.status
                print(f"{t - begin:6.1f} s  {status}{': ' if pose.reason else ''}{pose.reason}")
    return count


def track(source: Source, out: str, *words: str) -> None:
    """Track the images of a source, and write the run folder `out`."""
    with source as (camera, images), th.Slam(camera, *words, out=out, outputs=["trajectory", "surface", "building"]) as slam:
        count = show(slam, images)
    print(f"{count} frames, {len(slam.mesh().triangles)} triangles, rooms: {len(slam.building().rooms)}")
    print(f"surface {out}/surface.ply, floor plan {out}/floorplan.svg")


def main(source: str = "room", *words: str, out: str = "runs/camera") -> None:
    if source in ("realsense", "oak"):
        track(realsense() if source == "realsense" else oak(), out, *words)
    else:
        track(replay(th.dataset.synthetic(length=60) if source == "room" else th.dataset.folder(path=source)), out, *words)


def command(*words: str) -> None:
    """Be the program: print its help, or one line for a mistake."""
    if {"-h", "--help"} & set(words):
        return print(__doc__)
    try:
        out = [word[4:] for word in words if word.startswith("out=")]
        main(*(word for word in words if not word.startswith("out=")), **({"out": out[-1]} if out else {}))
    except ModuleNotFoundError as error:
        sys.exit(f"camera_loop: {error.name}: is not installed; install it with: {MAKERS.get(error.name or '', f'pip install {error.name}')}")
    except (th.TrihedronError, ImportError) as error:
        sys.exit(f"camera_loop: {error}")


if __name__ == "__main__":
    command(*sys.argv[1:])
