"""Libraries that are imported when they are needed: one line names the one that is missing and the command that installs it."""

from __future__ import annotations

import importlib.metadata
import platform
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from trihedron.pipeline.core.errors import LibraryError

DISTRIBUTIONS = {  # module -> the distribution that holds it, where the names differ
    "PIL": "pillow",
    "cv2": "opencv-contrib-python-headless",
    "foxglove": "foxglove-sdk",
    "google": "protobuf",
    "hydra": "hydra-core",
    "hydra_plugins.hydra_joblib_launcher": "hydra-joblib-launcher",
    "hydra_plugins.hydra_submitit_launcher": "hydra-submitit-launcher",
    "mcap_protobuf": "mcap-protobuf-support",
    "mcap_ros2": "mcap-ros2-support",
    "open3d": "open3d-cpu" if (sys.platform, platform.machine()) == ("linux", "x86_64") else "open3d",  # as pyproject.toml declares
    "rerun": "rerun-sdk",
    "yaml": "pyyaml",
}


@contextmanager
def imports_of(module: str) -> Iterator[None]:
    """Turn a failed import within the block into one line. Raises LibraryError.

    with imports_of("rosbags"):
        from rosbags import rosbag1
    """
    try:
        yield
    except ImportError as error:
        raise library_error(module, error) from error


def library_error(module: str, error: ImportError | None = None) -> LibraryError:
    """Return the error of a library that is not installed, or that does not load for the reason that its import gave."""
    name, cure = distribution_of(module), f"install it with: {install_command(module)}"
    if error is None or (isinstance(error, ModuleNotFoundError) and find_spec(module) is None):
        return LibraryError(name, "is not installed", cure)
    if "shared object file" in str(error):
        cure = "`python -m trihedron.tools.system_check` names the missing Debian packages"
    return LibraryError(name, f"does not load: {error}", cure)


def distribution_of(module: str) -> str:
    """Return the name by which pip knows the library of a top-level module."""
    return DISTRIBUTIONS.get(module, module.replace("_", "-").lower())


def install_command(module: str) -> str:
    """Return the command that installs the library of a module, or a distribution: by the extra that declares it, else by its own name."""
    name = distribution_of(module)
    extra = next((extra for extra, names in declared_requirements().items() if extra and name in names), "")
    return f"pip install 'trihedron[{extra}]'" if extra else f"pip install {name}"


def declared_requirements() -> dict[str, list[str]]:
    """Return the distributions that the installed package requires on this system: of its base under "", then of each extra."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    groups = ("", *(importlib.metadata.metadata("trihedron").get_all("Provides-Extra") or ()))
    found: dict[str, list[str]] = defaultdict(list)
    for requirement in map(Requirement, importlib.metadata.requires("trihedron") or ()):
        marker = requirement.marker
        group = next((extra for extra in groups if marker is None or marker.evaluate({"extra": extra})), None)
        if group is not None and requirement.name != "trihedron":  # extras of its own, which another extra includes
            found[group].append(canonicalize_name(requirement.name))
    return {extra: sorted(names) for extra, names in found.items()}
