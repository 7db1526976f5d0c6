"""Libraries that take long to import, imported when a plugin first runs, with one thread each.

Open3D takes 1.6 s to import and pycolmap 0.3 s, so nothing imports them for a plugin that is not used.
"""

from __future__ import annotations

import threading
from functools import cache
from typing import Any

from trihedron.pipeline.core.libraries import imports_of

RANDOM = threading.Lock()  # held while a library's one generator of random numbers is seeded and used


def open3d() -> Any:
    """Import Open3D (MIT) with one thread: sums that are split over threads change with the scheduler. Raises LibraryError."""
    return _open3d()


def pycolmap() -> Any:
    """Import pycolmap (BSD). Raises LibraryError."""
    with imports_of("pycolmap"):
        import pycolmap
    return pycolmap


def onnxruntime() -> Any:
    """Import ONNX Runtime (MIT). Raises LibraryError."""
    with imports_of("onnxruntime"):
        import onnxruntime
    return onnxruntime


@cache
def _open3d() -> Any:
    with imports_of("open3d"):
        import open3d
    open3d.utility.set_max_threads(1)
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
