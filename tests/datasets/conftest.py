"""Tiny sequences on disk, and what tests of data sets measure with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.types import F64, Frame

WIDTH, HEIGHT = 32, 24
CAMERA = f"width: {WIDTH}\nheight: {HEIGHT}\nfx: 30.0\nfy: 30.0\ncx: 15.5\ncy: 11.5\ndepth_scale: 1000\n"


@pytest.fixture
def shared_data() -> Path:
    """The folder of published sequences beside the repository."""
    path = Path(__file__).resolve().parents[2].parent / "shared" / "data"
    if not path.is_dir():
        pytest.skip(f"{path} is not beside this checkout")
    return path


@pytest.fixture
def write_images() -> Callable[..., None]:
    """Write a grey colour image and a depth image of 2 m (value 2000)."""

    def write(color: Path, depth: Path, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
        for path in (color, depth):
            path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(color), np.full((*size, 3), (10, 100, 200), dtype=np.uint8))  # blue, green, red
        assert cv2.imwrite(str(depth), np.full(size, 2000, dtype=np.uint16))

    return write


@pytest.fixture
def tum_folder(tmp_path: Path, write_images: Callable[..., None]) -> Path:
    """A TUM sequence of 4 pairs at 10, 10.1, 10.2, 10.3 s (depth 5 ms later), 32 × 24, with truth for three of them."""
    folder = tmp_path / "sequence"
    stamps = [f"10.{i}00000" for i in range(4)]
    for stamp in stamps:
        write_images(folder / f"rgb/{stamp}.png", folder / f"depth/{stamp}.png")
    (folder / "rgb.txt").write_text("# colour\n" + "".join(f"{s} rgb/{s}.png\n" for s in stamps))
    (folder / "depth.txt").write_text("# depth\n" + "".join(f"10.{i}05 depth/{s}.png\n" for i, s in enumerate(stamps)))
    (folder / "groundtruth.txt").write_text("".join(f"10.{i}00000 {i} 0 0 0 0 0 1\n" for i in range(3)))
    (folder / "camera.yaml").write_text(CAMERA)
    return folder


@pytest.fixture
def plain_folder(tmp_path: Path, write_images: Callable[..., None]) -> Path:
    """A folder of 3 pairs color/N.png, depth/N.png, numbered 8, 9, 10, 32 × 24."""
    folder = tmp_path / "plain"
    for number in (8, 9, 10):
        write_images(folder / f"color/{number}.png", folder / f"depth/{number}.png")
    (folder / "camera.yaml").write_text(CAMERA + "fps: 20\n")
    return folder


@pytest.fixture
def warp_error_m() -> Callable[[Frame, Frame, F64, F64], float]:
    """Median difference between the depth of frame b and that of frame a carried there by the poses, where both are known."""

    def measure(a: Frame, b: Frame, T_world_a: F64, T_world_b: F64) -> float:
        y, x = np.nonzero(a.depth_m)
        points = a.camera.back_project(np.stack([x, y], axis=-1).astype(float), a.depth_m[y, x].astype(float))
        carried = transform(invert(T_world_b) @ T_world_a, points)
        pixels = np.rint(np.nan_to_num(a.camera.project(carried), nan=-1.0)).astype(int)
        inside = ((pixels >= 0) & (pixels < (a.camera.width, a.camera.height))).all(axis=1)
        seen = b.depth_m[pixels[inside, 1], pixels[inside, 0]]
        assert (seen > 0).mean() > 0.3
        return float(np.median(np.abs(seen - carried[inside, 2])[seen > 0]))

    return measure
