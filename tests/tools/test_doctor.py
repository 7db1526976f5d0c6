"""`trihedron doctor` names versions, processor and what is missing."""

from importlib.metadata import version

from trihedron.tools import doctor


def lines_of(capsys):
    return {" ".join(line.split("  ")[0].split()): line for line in capsys.readouterr().out.splitlines()}


def test_versions(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "REQUIRED", ("numpy",))
    code, installed = doctor.main([]), [name for name in doctor.required() if doctor.version_of(name) is None]
    lines = lines_of(capsys)
    assert code == bool(installed) and (f"  missing: pip install {' '.join(installed)}" in lines.values()) == bool(installed)
    assert lines["trihedron"].split()[1] == version("trihedron")
    assert lines["numpy"].split() == ["numpy", version("numpy")]
    assert {"numba", "mcap", "hydra-core"} < set(doctor.required())
    assert doctor.processor() in lines["processor"] and "GB free" in lines["memory"]
    assert any(word in lines["compiled functions"] for word in ("complete", "for tracking", "not yet"))


def test_what_is_missing_is_named_with_its_cure(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "required", lambda: ["numpy", "no-such-package"])
    monkeypatch.setattr(doctor, "EXTRAS", {"no-such-extra": "view=nothing"})
    assert doctor.main([]) == 1
    lines = lines_of(capsys)
    assert lines["no-such-package"].split() == ["no-such-package", "missing"]
    assert lines["no-such-extra"].endswith("not installed; needed for view=nothing: pip install no-such-extra")
    assert lines[""].strip() == "missing: pip install no-such-package"
