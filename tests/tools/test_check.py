"""`trihedron check`: all plugins keep the contract of their slot, and each breach of it is found."""

import itertools
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.options import Range
from trihedron.pipeline.core.registry import load_plugins, plugins_of
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.types import Frame, Keypoints, Normals, Pose
from trihedron.plugins.keypoints.orb import Orb
from trihedron.plugins.lines.lsd import Lsd
from trihedron.plugins.manhattan.mean_shift import MeanShift
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.normals.cross_product import CrossProduct
from trihedron.plugins.planes.connected_components import ConnectedComponents
from trihedron.plugins.pose.refine import Refine
from trihedron.plugins.tracks.projection import Projection
from trihedron.tools.new_plugin import TEMPLATE_SENTENCE
from trihedron.tools.plugin_check import PluginCheck, room

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "plugins"))
from faulty_plugins import broken
from small_networks import network_words

load_plugins()
BUILT_IN = {(slot, name): kind for slot in SLOTS for name, kind in plugins_of(slot).items() if kind.__module__.startswith("trihedron.")}
EVERY = [pytest.param(slot, name, id=f"{slot}={name}") for slot, name in BUILT_IN]
WORDS = {("surface", "open3d_poisson"): ["surface.depth=5"]}  # so that little work is done


def words_for(slot, name, folder):
    """Words with which a plugin is checked."""
    return network_words(slot, folder) if name.startswith("onnx") else WORDS.get((slot, name), [])


def wrong(results):
    return {result.name: result.detail for result in results if not result.good}


TOYS = {("normals", "onnx"): {"true normals"}, ("planes", "onnx"): {"moments"}}  # the networks of the tests have learned nothing of surfaces


@pytest.mark.slow
@pytest.mark.parametrize(("slot", "name"), EVERY)
def test_every_plugin(slot, name, tmp_path):
    found = wrong(PluginCheck(slot, name, tuple(words_for(slot, name, tmp_path))).results(quick=True))
    assert set(found) <= TOYS.get((slot, name), set()), found


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
    assert " ".join(line.split()[0] for line in lines[1:-1]) == (
        "documented options values stamps unit towards true adverse inputs no threads processes replay library differs time"
    )
    assert lines[4] == "  stamps              ok  time from the frame's stamp to that of the value is 0 s, must be 0, frame 0"
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


@dataclass(frozen=True)
class Template(Good):
    __doc__ = TEMPLATE_SENTENCE


def check(kind):
    return wrong(PluginCheck("normals", kind.__name__, given=kind()).results(quick=True))


def test_a_good_plugin():
    assert check(Good) == {}


def test_the_sentence_of_the_template_is_no_documentation():
    assert PluginCheck("normals", "Good", given=Good()).static()[0].status == "ok"
    found = PluginCheck("normals", "Template", given=Template()).static()[0]
    assert (found.status, found.detail) == ("-", "the docstring is the template's; state what the method computes")


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
    room.cache_clear()  # Changing has written into it
    assert name in found
    assert found[name].startswith(detail), found


def test_mistakes_are_one_line(capsys):
    assert main(["check", "normals", "cross_produkt"]) == 1
    assert capsys.readouterr().err == (
        "trihedron: normals: there is no plugin 'cross_produkt' for the slot 'normals'; did you mean 'cross_product'?\n"
    )
    assert main(["check", "keypoints", "onnx"]) == 1
    assert capsys.readouterr().err.startswith("trihedron: keypoints.model: no network is given; give keypoints.model=FILE.onnx; ")


def rotated(value, degrees):
    """The axes, or a pose, rotated about the direction of view."""
    R = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(degrees)]))[0]
    if isinstance(value, Pose):
        T = value.T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ R
        return replace(value, T_world_camera=T, T_reference_camera=np.eye(4), reference=-1)
    return replace(value, rotations=R @ value.rotations)


def moved(value, axis, by):
    """Key points or lines that lie elsewhere in the image."""
    name = "pixels" if isinstance(value, Keypoints) else "endpoints_px"
    pixels = getattr(value, name).copy()
    pixels[..., axis] += np.float32(by)
    return replace(value, **{name: pixels})


def with_stamps(value, stamps):
    keyframes = value.keyframes
    return replace(value, keyframes=keyframes.updated(np.arange(len(keyframes)), stamp_ns=stamps(keyframes.column("stamp_ns"))))


def without_order(descriptors):
    return np.random.default_rng(0).permutation(descriptors)


MUTANTS = {  # name -> the plugin, what a mutant of it does to its values, the check that fails, and its line
    "planes: d < 0": (
        ConnectedComponents, lambda v: replace(v, coefficients=-v.coefficients),
        "signs", "d of plane 0 is -3.39 m, must be at least 0, frame 0",
    ),
    "planes: zero moments": (
        ConnectedComponents, lambda v: replace(v, moments=0.0 * v.moments),
        "moments", "weight of the moments of plane 0, of that of its pixels, is 0, must be 0.05 to 2, frame 0",
    ),
    "planes: indefinite covariance": (
        ConnectedComponents, lambda v: replace(v, covariance=-v.covariance),
        "covariances", "smallest eigenvalue of a covariance, by its diagonal, is -2.08, must be at least 1e-09, frame 0",
    ),
    "planes: covariance of a hundredth": (
        ConnectedComponents, lambda v: replace(v, covariance=1e-4 * v.covariance),
        "scatter", "scatter of planes in repeats of a view is 28.6 of the stated σ, must be 0.03 to 5",
    ),
    "planes: smallest first": (
        ConnectedComponents, lambda v: replace(v, pixels=v.pixels[::-1].copy()),
        "regions", "increase of `pixels` from a row to the next is 2.54e+04 px, must be at most 0, frame 0",
    ),
    "planes: samples elsewhere": (
        ConnectedComponents, lambda v: replace(v, samples_m=v.samples_m + np.float32(1.0)),
        "points on planes", "median distance of the samples of plane 0 from it is 16.9 σ, must be at most 3, frame 0",
    ),
    "normals: not of length 1": (
        CrossProduct, lambda v: replace(v, normals=2.0 * v.normals),
        "unit normals", "length of a normal is 2, must be 0.999 to 1.001, frame 0",
    ),
    "normals: away": (
        CrossProduct, lambda v: replace(v, normals=-v.normals),
        "towards the camera", "share of normals that point away from the camera is 1, must be at most 0, frame 0",
    ),
    "normals: all the same": (
        CrossProduct, lambda v: replace(v, normals=0.0 * v.normals + np.float32([0, 0.6, -0.8])),
        "true normals", "median angle to the true normals is 30.9 deg, must be at most 10, frame 0",
    ),
    "keypoints: outside of the image": (
        Orb, lambda v: moved(v, 0, 320.0),
        "in the image", "distance of a point outside of the image is 300 px, must be at most 0, frame 0",
    ),
    "keypoints: beside their 3D points": (
        Orb, lambda v: moved(v, 0, -1.0),
        "positions", "distance of a projected point from its pixel is 1 px, must be at most 0.05, frame 0",
    ),
    "keypoints: sigma_m of nothing": (
        Orb, lambda v: replace(v, sigma_m=0.0 * v.sigma_m),
        "sigmas", "least sigma_m is 0 m, must be at least 1e-06, frame 0",
    ),
    "keypoints: descriptors of others": (
        Orb, lambda v: replace(v, descriptors=without_order(v.descriptors)),
        "scatter", "distance of their descriptors, of that of others, is 1, must be at most 0.9",
    ),
    "lines: outside of the image": (
        Lsd, lambda v: moved(v, 1, -240.0),
        "in the image", "distance of a point outside of the image is 236 px, must be at most 1, frame 0",
    ),
    "manhattan: wrong angle": (
        MeanShift, lambda v: rotated(v, 10.0),
        "true axes", "angle of the axes from the truth is 9.9 deg, must be at most 2, frame 0",
    ),
    "manhattan: singular covariance": (
        MeanShift, lambda v: replace(v, covariance=0.0 * v.covariance),
        "axes", "smallest eigenvalue of a covariance, by its diagonal, is 0, must be at least 1e-09, frame 0",
    ),
    "pose: stamps of no frame": (
        Refine, lambda v: replace(v, stamp_ns=-v.stamp_ns),
        "stamps", "time from the frame's stamp to that of the value is -0.0667 s, must be 0, frame 1",
    ),
    "pose: wrong angle": (
        Refine, lambda v: rotated(v, 5.0),
        "true pose", "angle of the rotation from the truth is 5 deg, must be at most 2, frame 0",
    ),
    "pose: indefinite covariance": (
        Refine, lambda v: replace(v, covariance=-np.eye(6)),
        "pose", "smallest eigenvalue of `covariance`, by its diagonal, is -1, must be at least -1e-06, frame 0",
    ),
    "map: descending stamps": (
        Covisibility, lambda v: with_stamps(v, lambda stamps: stamps[::-1]),
        "keyframe order", "least step of `stamp_ns` from a keyframe to the next is -4e+08, must be at least 1, frame 2",
    ),
    "planes: constant covariance": (
        ConnectedComponents, lambda v: replace(v, covariance=0.0 * v.covariance + 1e-5 * np.eye(3)),
        "covariances", "number of different covariances, of 5, is 1, must be at least 2, frame 0",
    ),
    "tracks: pairs twice": (
        Projection, lambda v: replace(v, segments=np.repeat(v.segments, 2, 0), endpoints_m=np.repeat(v.endpoints_m, 2, 0)),
        "pairs", "number of pairs of one previous row of segments is 2, must be at most 1, frame 1",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "change", "name", "line"), MUTANTS.values(), ids=MUTANTS)
def test_a_broken_promise_is_found(kind, change, name, line):
    slot = kind.__module__.split(".")[-2]
    found = wrong(PluginCheck(slot, "mutant", given=broken(kind, change)).meanings())
    assert found.get(name) == f"{slot}=mutant: {line}"


def test_what_gives_no_value_is_neither_right_nor_wrong(capsys):
    assert main(["check", "bundle", "local_window", "dataset.length=2", "--quick"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "  ids              -   no value that it could be judged on" in lines
    assert "  differs          ok  it is the default" in lines
    assert lines[-1] == "all is well; 3 of 13 checks had nothing to judge (-)"


def test_the_values_of_the_default_are_no_difference():
    results = {
        result.name: result for result in PluginCheck("planes", "mine", given=broken(ConnectedComponents, lambda value: value)).results(quick=True)
    }
    assert (results["differs"].status, results["differs"].detail) == ("-", "all 8 values are those of connected_components, the default")
