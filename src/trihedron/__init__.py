"""RGB-D SLAM for man-made scenes: swappable stages, recorded topics, single-stage replay.

```python
import trihedron as th

slam = th.Slam(th.Camera.from_yaml("camera.yaml"), outputs=["trajectory", "surface"])
for rgb, depth, t in my_camera:
    pose = slam.track(rgb, depth, t)
slam.save("run.mcap")
```

`Slam` tracks frames that you push, `run` a data set. `Recording` reads every topic of a run and runs stages again. Each slot is a name, so that any
stage runs alone: `th.planes.connected_components(angle_deg=3)(depth, camera)`. Names are imported when they are first used. The import changes
nothing of the process.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if sys.platform == "win32":
    raise ImportError("trihedron does not run on Windows itself; install it in WSL 2, see docs/how-to/macos-and-windows.md")

if TYPE_CHECKING:
    from trihedron.ablations import ablate
    from trihedron.buildings import Building
    from trihedron.camera import Camera
    from trihedron.pipeline.core.errors import TrihedronError
    from trihedron.pipeline.core.registry import register
    from trihedron.pipeline.core.types import (
        CalibrationSigmas,
        Frame,
        Keypoints,
        LineSegments,
        ManhattanFrame,
        Map,
        Normals,
        Planes,
        Pose,
        Rotation,
        Segments,
        Surface,
        Translation,
    )
    from trihedron.recording import Recording
    from trihedron.runs import Run, compare, run
    from trihedron.slam import Slam
    from trihedron.stages import Slot
    from trihedron.trajectory import Trajectory

    __version__: str
    dataset: Slot
    normals: Slot
    keypoints: Slot
    lines: Slot
    segments: Slot
    planes: Slot
    manhattan: Slot
    tracks: Slot
    rotation: Slot
    translation: Slot
    matches: Slot
    pose: Slot
    map: Slot
    bundle: Slot
    loop: Slot
    relocalise: Slot
    model: Slot
    surface: Slot
    building: Slot

_TYPES = (
    "CalibrationSigmas", "Frame", "Keypoints", "LineSegments", "ManhattanFrame", "Map", "Normals", "Planes", "Pose", "Rotation", "Segments",
    "Surface", "Translation",
)  # fmt: skip
_SLOTS = (
    "dataset", "normals", "keypoints", "lines", "segments", "planes", "manhattan", "tracks", "rotation", "translation", "matches", "pose", "map",
    "bundle", "loop", "relocalise", "model", "surface", "building",
)  # fmt: skip
_HOMES = {
    "ablate": "ablations",
    "Building": "buildings",
    "Camera": "camera",
    "Recording": "recording",
    "Run": "runs",
    "Slam": "slam",
    "Trajectory": "trajectory",
    "TrihedronError": "pipeline.core.errors",
    "compare": "runs",
    "register": "pipeline.core.registry",
    "run": "runs",
    **dict.fromkeys(_TYPES, "pipeline.core.types"),
}

__all__ = [
    "Building", "CalibrationSigmas", "Camera", "Frame", "Keypoints", "LineSegments", "ManhattanFrame", "Map", "Normals", "Planes", "Pose",
    "Recording", "Rotation", "Run", "Segments", "Slam", "Surface", "Trajectory", "Translation", "TrihedronError", "__version__", "ablate", "building",
    "bundle", "compare", "dataset", "keypoints", "lines", "loop", "manhattan", "map", "matches", "model", "normals", "planes", "pose", "register",
    "relocalise", "rotation", "run", "segments", "surface", "tracks", "translation",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name in _HOMES:
        found = getattr(importlib.import_module(f"trihedron.{_HOMES[name]}"), name)
    elif name in _SLOTS:
        found = importlib.import_module("trihedron.stages").Slot(name)
    elif name == "__version__":
        from importlib.metadata import version

        found = version("trihedron")
    else:
        raise AttributeError(f"module 'trihedron' has no attribute '{name}'; public names: {', '.join(__all__)}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
