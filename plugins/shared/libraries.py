"""Optional libraries, imported when a plugin first runs: one thread each, and one line when they are missing.

Open3D takes 1.6 s to import and pycolmap 0.3 s, so nothing imports them for a plugin that is not used.
"""

from __future__ import annotations

import importlib
import threading
from functools import cache
from typing import Any

from trihedron.pipeline.core.errors import PluginError

RANDOM = threading.Lock()  # held while a library's one generator of random numbers is seeded and used


def open3d() -> Any:
    """Import Open3D (MIT) with one thread: sums that are split over threads change with the scheduler. Raises PluginError."""
    return _open3d()


def pycolmap() -> Any:
    """Import pycolmap (BSD). Raises PluginError."""
    return _imported("pycolmap", "pycolmap")


def onnxruntime() -> Any:
    """Import ONNX Runtime (MIT). Raises PluginError."""
    return _imported("onnxruntime", "onnxruntime")


@cache
def _open3d() -> Any:
    library = _imported("open3d", "open3d")
    if not hasattr(library.utility, "set_max_threads"):
        raise PluginError("open3d", f"version {library.__version__} cannot be held to one thread", "install it with: pip install 'open3d>=0.20'")
    library.utility.set_max_threads(1)
    library.utility.set_verbosity_level(library.utility.VerbosityLevel.Error)
    return library


def _imported(module: str, package: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module:
            raise PluginError(module, f"does not load: {error}", f"install it with: pip install '{package}'") from error
        raise PluginError(module, "is not installed", f"install it with: pip install '{package}'") from error
    except ImportError as error:
        cure = "`python -m trihedron.tools.system_check` names the missing Debian packages"
        raise PluginError(module, f"does not load: {error}", cure) from error
