"""A plugin that breaks its slot's contract is refused when it registers, with its name and file."""

import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest

from trihedron.pipeline.core import registry
from trihedron.pipeline.core.errors import PluginError
from trihedron.pipeline.core.registry import plugin_class, plugins_of, register
from trihedron.pipeline.core.types import Frame, Keypoints, Map, Normals, Surface


@pytest.fixture(autouse=True)
def own_plugins(monkeypatch):
    registry.load_plugins()
    monkeypatch.setattr(registry, "_PLUGINS", {slot: {} for slot in registry._PLUGINS})


def refusal(slot, cls, name="mine"):
    with pytest.raises(PluginError) as error:
        register(slot, name)(cls)
    return str(error.value).replace(__file__, "FILE")


@dataclass(frozen=True)
class Good:
    """Takes the slot's input and a generator."""

    level: float = 0.5

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Keypoints | None: ...


def test_a_good_plugin_is_found_by_name():
    assert register("keypoints", "mine")(Good) is Good
    assert plugin_class("keypoints", "mine") is Good and plugins_of("keypoints") == {"mine": Good}
    with pytest.raises(PluginError) as error:
        plugin_class("keypoints", "mime")
    assert str(error.value) == "keypoints: there is no plugin 'mime' for the slot 'keypoints'; did you mean 'mine'?"
    with pytest.raises(PluginError) as error:
        plugin_class("keypoint", "mine")
    assert str(error.value) == "keypoint: there is no slot 'keypoint'; did you mean 'keypoints'?"


def test_unknown_slot():
    assert refusal("keypoint", Good) == "plugin keypoint=mine (FILE): there is no slot 'keypoint'; did you mean 'keypoints'?"


def test_taken_name():
    register("keypoints", "mine")(Good)

    @dataclass(frozen=True)
    class Other:
        def __call__(self, frame: Frame) -> Keypoints | None: ...

    assert refusal("keypoints", Other) == "plugin keypoints=mine (FILE): the name is taken by FILE; register it under another name"


def test_not_a_frozen_dataclass():
    @dataclass
    class Mutable:
        def __call__(self, frame: Frame) -> Keypoints | None: ...

    expected = "plugin keypoints=mine (FILE): is not a frozen dataclass; put @dataclass(frozen=True) under @register"
    assert refusal("keypoints", Mutable) == expected


def test_foreign_parameter():
    @dataclass(frozen=True)
    class Asks:
        def __call__(self, frme: Frame) -> Keypoints | None: ...

    expected = "plugin keypoints=mine (FILE): __call__ takes 'frme', which the slot 'keypoints' does not give; did you mean 'frame'?"
    assert refusal("keypoints", Asks) == expected


def test_wrong_parameter_type():
    @dataclass(frozen=True)
    class Asks:
        def __call__(self, frame: Normals) -> Keypoints | None: ...

    assert refusal("keypoints", Asks) == "plugin keypoints=mine (FILE): __call__ takes 'frame' as Normals; the slot gives Frame"


def test_untyped_parameter():
    @dataclass(frozen=True)
    class Asks:
        def __call__(self, frame) -> Keypoints | None: ...

    assert refusal("keypoints", Asks) == "plugin keypoints=mine (FILE): __call__ takes 'frame' as nothing declared; the slot gives Frame"


def test_wrong_return_type():
    @dataclass(frozen=True)
    class Gives:
        def __call__(self, frame: Frame) -> Normals: ...

    assert refusal("keypoints", Gives) == "plugin keypoints=mine (FILE): returns Normals; the slot 'keypoints' returns Keypoints"


def test_no_call():
    @dataclass(frozen=True)
    class Empty:
        level: int = 0

    assert refusal("keypoints", Empty) == "plugin keypoints=mine (FILE): has no method __call__; the slot 'keypoints' needs it"


def test_a_fold_needs_three_methods():
    @dataclass(frozen=True)
    class Fold:
        def start(self) -> int: ...
        def add(self, state: int, frame: Frame) -> int: ...

    assert refusal("surface", Fold) == "plugin surface=mine (FILE): has no method finish; the slot 'surface' needs it"

    @dataclass(frozen=True)
    class Whole(Fold):
        def finish(self, state: int, map: Map | None) -> Surface: ...

    assert register("surface", "mine")(Whole) is Whole


def test_a_plugin_package_that_does_not_load_disables_only_itself(monkeypatch, capsys):
    class Entry:
        name, value, dist = "mine", "mine.plugins", None

        def load(self):
            raise self.error

    broken, exits, entries = Entry(), Entry(), []
    broken.error, exits.error, exits.value = ImportError("No module named 'mine'"), SystemExit(3), "other"
    loads = Entry()
    loads.value, loads.load = "whole", lambda: entries.append("loaded")
    monkeypatch.setattr(registry, "_BROKEN", {})
    monkeypatch.setattr(registry, "_load_built_in", lambda: None)  # they would register in this test's own table, and in no other
    monkeypatch.setattr(registry, "entry_points", lambda group: [broken, exits, loads])
    registry.load_plugins()
    registry.load_plugins()
    assert entries == ["loaded", "loaded"]
    assert capsys.readouterr().err.splitlines() == [  # once
        "trihedron: warning: plugin package mine (mine.plugins): does not load: ImportError: No module named 'mine'; "
        "it is left out until you mend or uninstall it",
        "trihedron: warning: plugin package mine (other): does not load: SystemExit: 3; it is left out until you mend or uninstall it",
    ]
    register("keypoints", "mine")(Good)
    with pytest.raises(PluginError) as error:
        registry.plugin_class("keypoints", "mime")
    assert str(error.value) == (
        "keypoints: there is no plugin 'mime' for the slot 'keypoints'; did you mean 'mine'?; "
        "it may be in mine (mine.plugins), which does not load: ImportError: No module named 'mine'; "
        "it may be in mine (other), which does not load: SystemExit: 3"
    )


def test_a_built_in_module_whose_library_is_missing_is_left_out():
    """In an installation of the packages in requirements-minimal.txt."""
    code = (
        "import sys; sys.modules['mcap_ros2'] = None; sys.modules['mcap_ros2.decoder'] = None; from trihedron.pipeline.core import registry; "
        "registry.load_plugins(); found = registry.plugins_of('dataset'); print('tum' in found, 'mcap' in found, registry.broken_packages())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.stdout.startswith("True False {'what needs mcap_ros2': 'mcap-ros2-support: "), done.stderr


def test_every_built_in_plugin_is_found_by_its_name_alone(monkeypatch):
    """Its module has its name, so that a run imports those of its own graph."""
    monkeypatch.undo()  # all plugins again
    registry.load_plugins()
    for slot in registry._PLUGINS:
        for name, plugin in plugins_of(slot).items():
            packages = registry.HOMES.get(slot, (f"trihedron.plugins.{slot}",))
            allowed = {f"{package}.{name}" for package in packages} | {"trihedron.plugins.none"}
            assert plugin.__module__ in allowed or not plugin.__module__.startswith("trihedron."), f"{slot}={name} is in {plugin.__module__}"


def test_a_graph_imports_no_plugin_of_another():
    code = (
        "import sys; from trihedron.pipeline.core.config import compose_run, graph_of; "
        "graph_of(compose_run(['graph=points', 'keypoints.features=200'])); "
        "print(*sorted(name for name in sys.modules if name.startswith('trihedron.plugins.')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    modules = done.stdout.split()
    assert "trihedron.plugins.keypoints.orb" in modules and "trihedron.plugins.surface.surfels" not in modules, done.stderr


def test_a_package_cannot_take_a_built_in_name(monkeypatch):
    monkeypatch.undo()
    assert refusal("keypoints", Good, "orb").endswith("register it under another name")
