"""Print which installed packages have another version than the lock, one a line. Usage: python .ci/differences.py constraints.txt"""

import importlib.metadata
import sys
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def locked_versions(path: Path, environment: dict[str, str] | None = None) -> dict[str, str]:
    """Return the versions of a lock by canonical name: those for an environment of markers (PEP 508), of this interpreter unless given.

    Raises ValueError where two versions of a package apply."""
    lines = [Requirement(line) for line in path.read_text().splitlines() if line and not line.startswith("#")]
    found: dict[str, str] = {}
    for line in lines:
        name = canonicalize_name(line.name)
        if line.marker is None or line.marker.evaluate(environment):
            if name in found:
                raise ValueError(f"{path}: two versions of {name} apply to one environment")
            found[name] = str(line.specifier).removeprefix("==")
    return found


def main() -> None:
    """Print the differences and their number."""
    versions = locked_versions(Path(sys.argv[1]))
    installed = {canonicalize_name(found.name): found.version for found in importlib.metadata.distributions()}
    differing = sorted(name for name in installed if name != "trihedron" and versions.get(name) != installed[name])
    for name in differing:
        print(f"{name} {versions.get(name, '(not in the lock)')} -> {installed[name]}")
    print(f"{len(differing)} of {len(installed)} packages differ from the lock")


if __name__ == "__main__":
    main()
