"""`trihedron doctor` names versions, processor and what is missing."""

import importlib.metadata
from importlib.metadata import version

from trihedron.pipeline.core.libraries import declared_requirements
from trihedron.tools import doctor


def lines_of(capsys):
    return {" ".join(line.split("  ")[0].split()): line for line in capsys.readouterr().out.splitlines()}


def test_versions(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "REQUIRED", ("numpy",))
    assert doctor.main([]) == 0
    lines = lines_of(capsys)
    assert lines["trihedron"].split()[1] == version("trihedron")
    assert lines["numpy"].split() == ["numpy", version("numpy")]
    for extra, names in declared_requirements().items():  # all libraries, of the base and of every extra
        assert names and {f"{name} [{extra}]" if extra else name for name in names} <= set(lines)
    assert lines["optuna [search]"].split() == ["optuna", "[search]", version("optuna")]
    assert doctor.processor() in lines["processor"] and "GB free" in lines["memory"]
    assert any(word in lines["compiled functions"] for word in ("complete", "for tracking", "not yet"))


def test_what_is_missing_is_named_with_its_cure(capsys, monkeypatch):
    requires = ["numpy>=1", "no_such-package>=2", 'trihedron[view]; extra == "dev"', 'no-such-viewer[web]>=3; extra == "view"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: requires)
    assert doctor.main([]) == 1
    lines = lines_of(capsys)
    assert lines["no-such-package"].split(maxsplit=1) == ["no-such-package", "missing; install with: pip install no-such-package"]
    assert lines["no-such-viewer [view]"].split(maxsplit=2)[2] == "missing; install with: pip install 'trihedron[view]'"
    assert lines[""].strip() == "missing: pip install no-such-package"
