"""Machine code that a wheel carries: the kernels, compiled when the wheel was built, for the processors of a baseline.

An archive holds the folders of the cache of kernels (`core.kernel`), and is of one version of Python, numba and llvmlite, and of x86-64-v3: AVX2, FMA
and what came with them, which Intel's and AMD's processors have had since 2013 and 2015. Where it fits, kernels are loaded from it, and what it lacks
is compiled for the same baseline; numba distinguishes machine code by its target. Where it does not, kernels are compiled for the processor.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import zipfile
from functools import cache
from pathlib import Path

import llvmlite
import numba
from llvmlite import binding

BASELINE = "x86-64-v3"
FEATURES = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "popcnt")  # that a processor of the baseline has, as LLVM names them
FOLDER = Path(__file__).parents[2] / "machine_code"  # of the archives: in the package
SUFFIX = ".zip"


def archive_name() -> str:
    """Name of the archive that fits these versions."""
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    return f"{python}-numba{numba.__version__}-llvmlite{llvmlite.__version__}-{sys.platform}-{BASELINE}{SUFFIX}"


def carried() -> list[str]:
    """Return the names of the archives in the package."""
    return sorted(file.name for file in FOLDER.glob(f"*{SUFFIX}"))


@cache
def archive() -> Path | None:
    """Return the archive that fits these versions and this processor; None where there is none."""
    return FOLDER / archive_name() if not why_unused() else None


@cache
def why_unused() -> str:
    """Return why no machine code of the package is used; empty where it is."""
    if not carried():
        return "this installation carries no machine code"
    if archive_name() not in carried():
        return f"the machine code of this installation is {', '.join(carried())}, which is not for {archive_name().removesuffix(SUFFIX)}"
    if os.environ.get("NUMBA_CPU_NAME") or os.environ.get("NUMBA_CPU_FEATURES"):
        return "NUMBA_CPU_NAME or NUMBA_CPU_FEATURES chooses another processor"
    has = binding.get_host_cpu_features()
    missing = [feature for feature in FEATURES if not has.get(feature, False)]
    return f"the machine code of this installation is for {BASELINE}, and this processor lacks {', '.join(missing)}" if missing else ""


def unpack(folder: Path) -> None:
    """Make a folder of the cache of kernels from the archive, whole or not at all, if it is not there yet and the archive has it. Raises OSError."""
    found = archive()
    if found is None or folder.exists():
        return
    with zipfile.ZipFile(found) as content:
        names = _names(found).get(folder.name, ())
        if not names:
            return
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            content.extractall(part, names)
            (part / folder.name).rename(folder)
        except OSError:
            if not folder.exists():  # else another process was first
                raise
        finally:
            shutil.rmtree(part, ignore_errors=True)


@cache
def _names(archive: Path) -> dict[str, tuple[str, ...]]:
    """Return the files of each folder in an archive."""
    folders: dict[str, list[str]] = {}
    with zipfile.ZipFile(archive) as content:
        for name in content.namelist():
            folders.setdefault(name.partition("/")[0], []).append(name)
    return {folder: tuple(names) for folder, names in folders.items()}


def pack(kernels: Path, out: Path) -> None:
    """Write the folders of a cache of kernels into an archive, in the order of their names and without times: equal content gives equal bytes."""
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as content:
        for file in sorted(kernels.glob("*/*")):
            content.writestr(zipfile.ZipInfo(f"{file.parent.name}/{file.name}"), file.read_bytes(), zipfile.ZIP_DEFLATED, 9)
