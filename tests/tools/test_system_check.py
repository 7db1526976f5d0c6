"""A missing system library is named with its Debian package, in one line."""

import pytest

from trihedron.tools import system_check

LOADER = "Traceback (most recent call last):\n  File ...\nImportError: {}: cannot open shared object file: No such file or directory"


@pytest.mark.parametrize(
    ("library", "package"), [("libGL.so.1", "libgl1"), ("libgomp.so.1", "libgomp1"), ("libX11.so.6", "libx11-6"), ("libEGL.so.1", "libegl1")]
)
def test_one_missing_library(monkeypatch, library, package):
    monkeypatch.setattr(system_check, "loads", lambda _: True)
    found = system_check.check("open3d", lambda _: LOADER.format(library))
    assert found == f"open3d needs {library}; install it with: apt-get install {package}"


def test_all_missing_libraries_are_named_at_once(monkeypatch):
    monkeypatch.setattr(system_check, "loads", lambda library: library not in ("libGL.so.1", "libX11.so.6"))
    found = system_check.check("open3d", lambda _: LOADER.format("libX11.so.6"))
    assert found == "open3d needs libX11.so.6, libGL.so.1; install them with: apt-get install libgl1 libx11-6"


def test_an_unknown_library_and_another_error():
    found = system_check.check("cv2", lambda _: LOADER.format("libfoo.so.3"))
    assert found == "cv2 needs libfoo.so.3; find the Debian package that holds it with: apt-file search libfoo.so.3"
    found = system_check.check("cv2", lambda _: "Traceback ...\nModuleNotFoundError: No module named 'cv2'")
    cure = "install it again with: pip install --force-reinstall opencv-contrib-python-headless"
    assert found == f"cv2 does not load: ModuleNotFoundError: No module named 'cv2'; {cure}"


def test_a_module_that_loads():
    assert system_check.check("json") == ""
    assert not system_check.loads("libnothing-of-the-kind.so.1")


def test_one_line_says_that_all_is_well(monkeypatch, capsys):
    monkeypatch.setattr(system_check, "REQUIRED", ("json",))
    monkeypatch.setattr(system_check, "OPTIONAL", ("csv",))
    assert system_check.main() == 0
    assert capsys.readouterr() == ("all libraries load: json, csv\n", "")


@pytest.mark.parametrize(("required", "code", "remark"), [(True, 1, ""), (False, 3, " (only the stages that use it need it)")])
def test_only_a_required_module_is_an_error(monkeypatch, capsys, required, code, remark):
    monkeypatch.setattr(system_check, "REQUIRED", ("json", "no_such_module") if required else ("json",))
    monkeypatch.setattr(system_check, "OPTIONAL", () if required else ("no_such_module",))
    assert system_check.main() == code
    said = "trihedron: no_such_module does not load: ModuleNotFoundError: No module named 'no_such_module'; "
    assert capsys.readouterr().err == said + "install it again with: pip install --force-reinstall no-such-module" + remark + "\n"
