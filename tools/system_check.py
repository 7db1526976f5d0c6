"""Check that the libraries the wheels expect of the system are there, and name the Debian packages of those that are not.

Example: python -m trihedron.tools.system_check
"""

from __future__ import annotations

import ctypes
import re
import subprocess
import sys
from collections.abc import Callable

from trihedron.pipeline.core.libraries import distribution_of

REQUIRED = ("cv2", "numba", "scipy")  # nothing runs without these
OPTIONAL = ("open3d", "pycolmap")  # only the stages that use them do not run
PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLU.so.1": "libglu1-mesa",
    "libSM.so.6": "libsm6",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libgcc_s.so.1": "libgcc-s1",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libgomp.so.1": "libgomp1",
    "libgthread-2.0.so.0": "libglib2.0-0",
    "libidn2.so.0": "libidn2-0",
    "libstdc++.so.6": "libstdc++6",
    "libtbb.so.12": "libtbb12",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libxcb.so.1": "libxcb1",
    "libz.so.1": "zlib1g",
}
OPEN3D_NEEDS = (  # the loader names only the first that is missing
    "libEGL.so.1", "libGL.so.1", "libX11.so.6", "libgomp.so.1", "libidn2.so.0", "libudev.so.1", "libusb-1.0.so.0",
)  # fmt: skip


def main() -> int:
    """Import each module in a process of its own; print one line for each that does not load, or one where all do.

    Returns 0 when all load, 1 when a required one does not, 3 when only optional ones do not."""
    code = 0
    for module in (*REQUIRED, *OPTIONAL):
        problem = check(module)
        if problem:
            print(f"trihedron: {problem}" + ("" if module in REQUIRED else " (only the stages that use it need it)"), file=sys.stderr)
            code = 1 if module in REQUIRED else code or 3
    if not code:
        print(f"all libraries load: {', '.join((*REQUIRED, *OPTIONAL))}")
    return code


def import_error(module: str) -> str:
    """Error of the interpreter when `module` is imported in a new process; empty when it loads."""
    done = subprocess.run([sys.executable, "-c", f"import {module}"], capture_output=True, text=True)
    return "" if done.returncode == 0 else done.stderr.strip() or f"the interpreter ended with code {done.returncode}"


def check(module: str, run: Callable[[str], str] = import_error) -> str:
    """Check a module: what is wrong with it and what to do about it, in one line; empty when it loads."""
    error = run(module)
    if not error:
        return ""
    found = re.search(r"(\S+?\.so[.\d]*): cannot open shared object file", error)
    if not found:
        return f"{module} does not load: {error.splitlines()[-1]}; install it again with: pip install --force-reinstall {distribution_of(module)}"
    others = [library for library in OPEN3D_NEEDS if module == "open3d" and library != found[1] and not loads(library)]
    libraries = [found[1], *others]
    packages = sorted({PACKAGES[library] for library in libraries if library in PACKAGES})
    if not packages:
        return f"{module} needs {found[1]}; find the Debian package that holds it with: apt-file search {found[1]}"
    return f"{module} needs {', '.join(libraries)}; install {'it' if len(libraries) == 1 else 'them'} with: apt-get install {' '.join(packages)}"


def loads(library: str) -> bool:
    """Return True if the system's loader finds a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
