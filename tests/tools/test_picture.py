"""`trihedron picture`: what its title names of a recording, and its size."""

from __future__ import annotations

from pathlib import Path

import cv2

import trihedron as th
from trihedron.comparison.pictures import _contents, draw
from trihedron.pipeline.record.reader import Recording

SMALL = {"dataset__length": 4, "dataset__width": 160, "dataset__height": 120}


def test_the_title_names_the_features_that_a_recording_holds(tmp_path: Path) -> None:
    run = th.run(out=tmp_path / "run", quiet=True, **SMALL)
    assert _contents(Recording(tmp_path / "run" / "run.mcap")) == "planes, 3D lines, key points, Manhattan axes"
    draw(str(tmp_path / "run" / "run.mcap"), -1, tmp_path / "picture.png")
    assert cv2.imread(str(tmp_path / "picture.png")).shape == (768, 1920, 3)
    run.recording.replay(only=["rotation"], out=tmp_path / "again")
    assert _contents(Recording(tmp_path / "again" / "run.mcap")) == "no features; the recording holds no images"
