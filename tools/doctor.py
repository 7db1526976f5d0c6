"""Print versions, processor, compiled functions and the libraries of each extra: what to put into a bug report.

Exit code 0 when all that a run needs is there, 1 when something is missing.

Example: trihedron doctor
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from importlib.util import find_spec
from pathlib import Path

from trihedron.pipeline.core.libraries import declared_requirements, install_command
from trihedron.pipeline.core.text_table import table
from trihedron.tools.arguments import Parser
from trihedron.tools.system_check import OPTIONAL, REQUIRED, check


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code."""
    Parser("doctor", __name__).parse(argv)
    libraries = declared_requirements()
    missing = [name for name in libraries.get("", ()) if version_of(name) is None]
    broken = {module: problem for module in (*REQUIRED, *OPTIONAL) if find_spec(module) is not None and (problem := check(module))}
    rows = [
        ["trihedron", f"{version_of('trihedron')} in {Path(__file__).resolve().parents[1]}"],
        ["python", f"{platform.python_version()} {sys.executable}"],
    ]
    rows += [["system", platform.platform()], ["processor", f"{processor()}, {os.cpu_count()} cores"], ["memory", memory_text()]]
    rows += [["compiled functions", compiled_text()]]
    for extra, names in libraries.items():
        suffix = f" [{extra}]" if extra else ""
        rows += [[name + suffix, version_of(name) or f"missing; install with: {install_command(name)}"] for name in names]
    print(table(rows, "ll"))
    for module, problem in broken.items():
        print(f"  {problem}" + ("" if module in REQUIRED else " (only the stages that use it need it)"))
    if missing:
        print(f"  missing: pip install {' '.join(missing)}")
    return 1 if missing or set(REQUIRED) & set(broken) else 0


def version_of(package: str) -> str | None:
    """Return the version of an installed package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def processor() -> str:
    """Return the processor's name as the system has it."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor() or platform.machine())


def memory_text() -> str:
    """Return the memory of the machine and what is free of it."""
    file = Path("/proc/meminfo")
    if not file.exists():
        return "unknown"
    kilobytes = {line.split(":")[0]: int(line.split()[1]) for line in file.read_text().splitlines()}
    return f"{kilobytes['MemTotal'] / 1e6:.1f} GB, {kilobytes['MemAvailable'] / 1e6:.1f} GB free"


def compiled_text() -> str:
    """Describe the cache of compiled functions."""
    from trihedron.pipeline.app.compilation import PARTS, marker
    from trihedron.pipeline.core.kernel import cache_folder
    from trihedron.pipeline.core.machine_code import archive, why_unused

    if archive() is not None:
        return f"complete, brought by this installation, in {cache_folder()}"
    done = [what for what in PARTS if marker(what).exists()]
    state = "complete" if "all" in done else "for tracking" if done else "not yet: the first run compiles, or trihedron compile"
    return f"{state}, in {cache_folder()}; {why_unused()}"
