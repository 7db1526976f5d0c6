"""Accounting of skipped tests: a skip for a reason that is not in ALLOWED fails the run, and a line says what to do."""

import re

import pytest

from trihedron.tools import system_check

ON_OPEN3D = re.compile(r"open3d|\b(graph=)?libraries\b")
ALLOWED = {  # pattern of a skip's reason -> why the development environment does not mend it
    r"could not import 'rclpy'": "ROS 2 is on no package index",
    r"is not beside this checkout": "the published sequences are gigabytes",
    r"needs the packages that examples/export_networks.py names": "PyTorch has an environment of its own",
    r"needs the packages that examples/look_at_ifc.py names": "VTK has an environment of its own",
    r"needs SLURM": "its daemons are a cluster's",
    r"another C library": "only glibc has the heaps",
    r"the kernels of x86-64": "another architecture",
    r"not a git checkout": "a source archive has no history",
    r"node and npm are not there|npm cannot install .*: its registry is not reached": "a reader in another language, over the network",
}


def pytest_collection_modifyitems(items):
    """Skip tests on Open3D where it does not load, with the Debian packages that it lacks as the reason."""
    on_open3d = [item for item in items if (call := getattr(item, "callspec", None)) and "path" not in call.params and ON_OPEN3D.search(call.id)]
    try:
        if on_open3d:
            import open3d  # noqa: F401
    except ImportError:
        skip = pytest.mark.skip(reason=system_check.check("open3d"))
        for item in on_open3d:
            item.add_marker(skip)


def skips_of(config):
    """Reason -> names of the tests that were skipped for it; empty in the workers of pytest-xdist, whose controller has all."""
    reporter, found = config.pluginmanager.get_plugin("terminalreporter"), {}
    for report in reporter.stats.get("skipped", []) if reporter else []:
        found.setdefault(report.longrepr[2].removeprefix("Skipped: "), []).append(report.nodeid)
    return found


def why_allowed(reason):
    return next((why for pattern, why in ALLOWED.items() if re.search(pattern, reason)), None)


def cure(reason):
    """End of the line on a skip that is not allowed; a reason that names a command is its own cure."""
    missing = re.match(r"could not import '([\w.]+)'", reason)
    if missing:
        return "; " + (system_check.check(missing[1]) if "shared object" in reason else "install it with: pip install -e '.[dev]'")
    return "" if "with: " in reason else "; make the test run, or add the reason to ALLOWED in tests/skips.py"


def pytest_sessionfinish(session, exitstatus):
    if exitstatus == pytest.ExitCode.OK and not all(map(why_allowed, skips_of(session.config))):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter, config):
    """List the skipped tests by reason: first those that are allowed, then those that fail the run."""
    skips = skips_of(config)
    if skips:
        terminalreporter.section("skipped tests")
    for reason in sorted(skips, key=lambda reason: why_allowed(reason) is None):
        why = why_allowed(reason)
        if why:
            terminalreporter.write_line(f"{len(skips[reason])} skipped: {reason} ({why})")
        for name in () if why else skips[reason]:
            terminalreporter.write_line(f"FAILED {name}: skipped: {reason}{cure(reason)}", red=True)
