"""`trihedron check`: all plugins keep the contract of their slot, and each breach of it is found."""

import itertools
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.options import Range
from trihedron.pipeline.core.registry import load_plugins, plugins_of
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.plugins.normals.cross_product import CrossProduct
from trihedron.tools.plugin_check import PluginCheck

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins"))
from small_networks import network_words

load_plugins()
BUILT_IN = {(slot, name): kind for slot in SLOTS for name, kind in plugins_of(slot).items() if kind.__module__.startswith("trihedron.")}
EVERY = [pytest.param(slot, name, id=f"{slot}={name}") for slot, name in BUILT_IN]
KEYFRAMES = ["map.min_turn_deg=0.5", "map.min_frames=1", "map.min_shift=0.001"]  # every frame is one
WORDS = {  # so that little work is done, or any at all
    ("pose", "icp"): ["model=tsdf"],
    ("surface", "open3d_poisson"): ["surface.depth=5"],
    ("loop", "bag_of_words"): ["loop.away_m=0.01", "loop.every=1", "loop.shared=100000", *KEYFRAMES],
}


def words_for(slot, name, folder):
    """Words with which a plugin is checked."""
    return network_words(slot, folder) if name.startswith("onnx") else WORDS.get((slot, name), [])


def wrong(results):
    return {result.name: result.detail for result in results if not result.good}


@pytest.mark.slow
@pytest.mark.parametrize(("slot", "name"), EVERY)
def test_every_plugin(slot, name, tmp_path):
    assert wrong(PluginCheck(slot, name, tuple(words_for(slot, name, tmp_path))).results(quick=True)) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slot", "name"), [("keypoints", "akaze"), ("keypoints", "onnx"), ("relocalise", "pycolmap_pnp"), ("planes", "open3d_patches")]
)
def test_plugins_over_libraries(slot, name, tmp_path):
    results = PluginCheck(slot, name, tuple(words_for(slot, name, tmp_path))).results(quick=True)
    assert wrong(results) == {}
    library = {result.name: result.detail for result in results}["library"]
    assert library.endswith("called") and library != "none is named"


def test_options_and_documentation_of_every_plugin():
    found = {key: wrong(PluginCheck(*key, given=plugin()).static()) for key, plugin in BUILT_IN.items()}
    assert {key: reasons for key, reasons in found.items() if reasons} == {}


@pytest.mark.slow
def test_the_page(capsys):
    assert main(["check", "normals", "cross_product"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("normals=cross_product: ")
    assert [line.split()[0] for line in lines[1:-1]] == (
        ["documented", "options", "values", "adverse", "inputs", "no", "threads", "processes", "replay", "library", "differs", "time"]
    )
    assert all(" ok " in line for line in lines[1:-1]) and lines[-1] == "all is well"


@dataclass(frozen=True)
class Good:
    """Normals of the cross product."""

    strength: Annotated[float, Range(0, 1)] = 0.5

    def __call__(self, frame: Frame) -> Normals:
        return CrossProduct()(frame)


class Counting(Good):
    """Count calls."""

    counter = itertools.count()

    def __call__(self, frame: Frame) -> Normals:
        value = CrossProduct()(frame)
        return replace(value, normals=np.roll(value.normals, next(self.counter), axis=0))


class Wrong(Good):
    """Return normals that are twice too long, of another frame."""

    def __call__(self, frame: Frame) -> Normals:
        return replace(CrossProduct()(frame), index=frame.index + 1)


class Fragile(Good):
    """Fail where there is no depth."""

    def __call__(self, frame: Frame) -> Normals:
        assert frame.depth_m.max() > 0.0
        return CrossProduct()(frame)


class Coarse(Good):
    """Return a grid that does not cover the image."""

    def __call__(self, frame: Frame) -> Normals:
        value = CrossProduct()(frame)
        return replace(value, normals=value.normals[:10])


class Idle(Good):
    """Name a library without a call of it. Library: SciPy (BSD)."""


class Changing(Good):
    """Write into the frame."""

    def __call__(self, frame: Frame) -> Normals:
        depth = frame.depth_m
        depth.flags.writeable = True
        depth += np.float32(0.001)
        return CrossProduct()(frame)


@dataclass(frozen=True)
class Undocumented(Good):
    more: float = 1.0


def check(kind):
    return wrong(PluginCheck("normals", kind.__name__, given=kind()).results(quick=True))


def test_a_good_plugin():
    assert check(Good) == {}


@pytest.mark.parametrize(
    ("kind", "name", "detail"),
    [
        (Counting, "no hidden state", "calls depend on earlier ones"),
        (Wrong, "values", "ValueError: returned a Normals of frame 1 at frame 0"),
        (Fragile, "adverse scenes", "no depth: AssertionError: "),
        (Coarse, "values", "the field 'normals' has 10 x 160 cells of 2 pixels, too few for the image"),
        (Idle, "library", "scipy is named and not called"),
        (Changing, "inputs", "a call changes its inputs: frame"),
        (Undocumented, "documented", "the class has no docstring that opens with what it does"),
    ],
)
def test_a_breach_is_found(kind, name, detail):
    found = check(kind)
    assert name in found
    assert found[name].startswith(detail), found


def test_mistakes_are_one_line(capsys):
    assert main(["check", "normals", "cross_produkt"]) == 1
    assert capsys.readouterr().err == (
        "trihedron: normals: there is no plugin 'cross_produkt' for the slot 'normals'; did you mean 'cross_product'?\n"
    )
    assert main(["check", "keypoints", "onnx"]) == 1
    assert capsys.readouterr().err.startswith("trihedron: keypoints.model: no network is given; give keypoints.model=FILE.onnx; ")
