"""Track an Intel RealSense camera and watch it in Foxglove (open ws://localhost:8765).

pip install 'trihedron[realsense]'
python examples/realsense_loop.py          # Ctrl-C ends it; the recording is in runs/realsense
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import trihedron as th

WIDTH, HEIGHT, FPS = 640, 480, 30


def camera_of(profile: Any, rs: Any) -> th.Camera:
    """Return the colour camera, to which depth is registered, with the device's unit of depth."""
    found = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    scale = 1.0 / profile.get_device().first_depth_sensor().get_depth_scale()
    distortion = tuple(found.coeffs) if any(found.coeffs) else ()
    return th.Camera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy, float(FPS), depth_scale=scale, distortion=distortion)


def images(pipeline: Any, align: Any) -> Iterator[tuple[Any, Any, float]]:
    """Yield registered pairs of images with their time in seconds, for as long as the camera sends them."""
    while True:
        pair = align.process(pipeline.wait_for_frames())
        color, depth = pair.get_color_frame(), pair.get_depth_frame()
        if color and depth:
            yield np.asarray(color.get_data()), np.asarray(depth.get_data()), color.get_timestamp() / 1e3


def main(out: str = "runs/realsense", *overrides: str) -> None:
    import pyrealsense2 as rs

    config = rs.config()
    config.enable_stream(rs.stream.color, WIDTH, HEIGHT, rs.format.rgb8, FPS)
    config.enable_stream(rs.stream.depth, WIDTH, HEIGHT, rs.format.z16, FPS)
    pipeline, align = rs.pipeline(), rs.align(rs.stream.color)
    profile = pipeline.start(config)
    try:
        with th.Slam(camera_of(profile, rs), *(overrides or ("view=foxglove",)), out=out) as slam:
            for rgb, depth, t in images(pipeline, align):
                pose = slam.track(rgb, depth, t)
                if pose.status != "ok":
                    print(f"{t:.3f} s: {pose.status}, {pose.reason}")
    except KeyboardInterrupt:
        print(f"the recording is in {out}")
    finally:
        pipeline.stop()


if __name__ == "__main__":
    main()
