"""What a user sees of values in a shell and in a notebook: one line each, and a small picture."""

import base64
import inspect
import re
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
import pytest

import trihedron as th
from trihedron.pipeline.core import types
from trihedron.pipeline.core.arrays import F32, Shape, Value
from trihedron.pipeline.core.pictures import picture_of

ROOM = th.dataset.synthetic(length=8, width=160, height=120)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    words = ["dataset.length=8", "dataset.width=160", "dataset.height=120", "outputs=[trajectory,surface]"]
    return th.run(*words, out=tmp_path_factory.mktemp("run") / "a", quiet=True)


@pytest.fixture(scope="module")
def values(run):
    """Topic -> the value of the last frame that has one."""
    return {topic: list(run.recording.values(topic))[-1] for topic in run.recording.topics}


LINES = {
    "planes": r"Planes\(\d+; \d+ % of 160 × 120; largest [\d.]+( k)? px\)",
    "keypoints": r"Keypoints\(\d+; \d+ with depth\)",
    "lines": r"LineSegments\(\d+\)",
    "segments": r"Segments\(\d+; \d+ in 3D\)",
    "manhattan": r"ManhattanFrame\(frame 7; inliers of the axes [\d.k ]+, [\d.k ]+, [\d.k ]+\)",
    "tracks": r"Tracks\(frame 6 to 7; \d+ points?, \d+ lines?, \d+ planes?\)",
    "rotation": r"Rotation\(frame 7; by (manhattan|tracks); σ [\d.e-]+°\)",
    "translation": r"Translation\(frame 7; .* m; σ [\d.]+ mm; \d+ points?, \d+ lines?, \d+ planes?\)",
    "matches": r"Matches\(frame 7; revision \d+; \d+ points?, \d+ lines?, \d+ planes?\)",
    "pose": r"Pose\(frame 7; ok; σ [\d.]+ mm, [\d.]+°\)",
    "map": r"Map\(revision \d+; \d+ keyframes?; \d+ points?, \d+ lines?, \d+ planes?\)",
    "surface": r"Surface\([\d.]+( k)? triangles; \d+ planes of [\d.]+ m²\)",
    "frames": r"FrameReference\(7 at 0\.\d+ s; 160 × 120\)",
}


@pytest.mark.parametrize("topic", LINES)
def test_each_topic_prints_as_one_line(values, topic):
    assert re.fullmatch(LINES[topic], repr(values[topic])), repr(values[topic])


def test_other_values_print_as_one_line(run, values):
    frame = ROOM(0)
    assert re.fullmatch(r"Frame\(0 at 0\.000 s; 160 × 120; depth in \d+ %, median \d\.\d\d m\)", repr(frame)), repr(frame)
    assert re.fullmatch(r"Normals\(frame 0; 80 × 60; every 2 px; known in \d+ %\)", repr(th.normals.integral_image()(frame)))
    assert re.fullmatch(r"Trajectory\(8 poses; 0\.\d s; \d\.\d\d m\)", repr(run.trajectory))
    assert re.fullmatch(r"Trajectory\(8 poses; 0\.\d s; \d\.\d\d m\)", repr(ROOM.truth()))
    assert re.fullmatch(r"Table\(\d+ rows?; position_m, .*alive\)", repr(values["map"].points))
    assert repr(types.Building.empty(3, 0, "no floor was seen")) == "Building(0 storeys, 0 rooms, 0 walls, 0 openings; no floor was seen)"
    assert repr(replace(values["pose"], status="lost", reason="no depth")).startswith("Pose(frame 7; lost; no depth; σ ")


def test_runs_and_recordings_print_as_one_line(run):
    assert re.fullmatch(rf"Run\({re.escape(str(run.folder))}; 8 ok; ATE [\d.]+ mm\)", repr(run)), repr(run)
    assert repr(run.recording) == f"Recording({run.folder / 'run.mcap'}; 8 frames; {len(run.recording.topics)} topics)"
    assert run.metrics["status"]["ok"] == 8 and len(run.trajectory) == 8


def test_a_type_of_a_plugin_prints_its_numbers_and_the_shapes_of_its_arrays():
    @dataclass(frozen=True)
    class Corners(Value):
        score: float
        pixels: Annotated[F32, Shape("n", 2)]

    class Own(Value):
        def __repr__(self):
            return "own"

    assert repr(Corners(4, 0, 0.5, np.zeros((900, 2), np.float32))) == "Corners(index=4, stamp_ns=0, score=0.5, pixels (900, 2))"
    assert repr(Own(0, 0)) == "own"


@pytest.mark.parametrize("topic", ["planes", "keypoints", "lines", "segments", "manhattan", "surface", "frame", "noise"])
def test_a_notebook_shows_a_small_picture(values, topic):
    """A PNG of at most 50 kB, with the line of the value below; noise is what compresses worst."""
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    depth = np.random.default_rng(0).uniform(0, 5, (480, 640)).astype(np.float32)
    frames = {"frame": ROOM(0), "noise": types.Frame(0, 0, noise, depth, th.Camera(640, 480, 525, 525, 319.5, 239.5))}
    value = (values | frames)[topic]
    page = value._repr_html_()
    png = base64.b64decode(re.search(r'src="data:image/png;base64,([^"]+)"', page)[1])
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert len(png) <= 50_000 and max(picture.shape[:2]) <= 320
    assert picture.std() > 3.0  # something is drawn
    assert f"<figcaption>{value!r}</figcaption>" in page


def test_what_has_no_picture_is_text_in_a_notebook(values):
    assert values["pose"]._repr_html_() is None
    assert values["map"]._repr_html_() is None
    assert types.Surface.empty(0, 0)._repr_html_() is None
    empty = replace(values["lines"], endpoints_px=np.empty((0, 2, 2), np.float32), descriptors=values["lines"].descriptors[:0])
    assert "<figcaption>LineSegments(0)</figcaption>" in empty._repr_html_()


def test_a_surface_is_seen_from_above_the_nearest_in_front():
    """A red floor with a green table on it, facing up, and a blue ceiling, which faces down."""
    square, colors = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), np.array([(255, 0, 0), (0, 255, 0), (0, 0, 255)], np.uint8)
    corners = [np.column_stack([size * (square - 0.5), np.full(4, z)]) for size, z in ((4.0, 0.0), (2.0, 0.5), (4.0, 2.0))]
    up = np.array([[0, 1, 2], [0, 2, 3]])
    surface = replace(
        types.Surface.empty(0, 0),
        vertices_m=np.concatenate(corners).astype(np.float32), colors=np.repeat(colors, 4, axis=0),
        triangles=np.concatenate([up, up + 4, up[:, ::-1] + 8]).astype(np.int32),
        instances=np.full(6, -1, np.int32), texels=np.full((6, 3, 2), np.nan, np.float32), up=np.array([0.0, 0.0, 1.0]),
    )  # fmt: skip
    for order in (np.arange(6), np.arange(6)[::-1]):
        picture = picture_of(replace(surface, triangles=surface.triangles[order]))
        red, green, blue = (int((picture == color).all(axis=2).sum()) for color in colors)
        assert red > 2 * green > 0 and blue == 0


def test_a_plan_is_drawn():
    number, none = np.zeros(1, np.int32), np.zeros(1)
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
    plan = replace(
        types.Building.empty(0, 0, ""),
        storeys=np.array([[0.0, 2.5]]), storey_covariance=np.zeros((1, 2, 2)),
        walls_m=corners[None, :2], wall_storeys=number, thickness_m=np.array([0.2]), wall_covariance=np.zeros((1, 3, 3)),
        room_storeys=number, loops=np.array([[0, 0, 4]], np.int32), corners_m=corners, corner_walls=np.array([0, -1, -1, -1], np.int32),
        edge_sigma_m=np.zeros(4), areas_m2=np.array([12.0]), area_variance=none, closed=np.zeros(1, bool),
    )  # fmt: skip
    building = th.Building(plan)
    assert repr(building) == "Building(1 storey, 1 room of 12.00 ± 0.00 m², 1 wall, 0 openings)"
    assert repr(building.rooms[0]).startswith("Room(number=0, storey=0, corners (4, 2), holes=(), edges=(") and len(repr(building.rooms[0])) < 300
    assert repr(building.walls[0].length_m) == "4.000 ± 0.000"
    page = building._repr_html_()
    assert page == plan._repr_html_() and "data:image/png;base64," in page


def test_a_stage_shows_its_options_with_defaults_and_what_they_are():
    parameters = inspect.signature(th.planes.cape).parameters
    assert {name: parameters[name].default for name in ("block_px", "share", "angle_deg")} == {"block_px": 20, "share": 0.5, "angle_deg": 15.0}
    assert parameters["block_px"].annotation is int and parameters["block_px"].kind is inspect.Parameter.KEYWORD_ONLY
    assert set(parameters) == set(re.findall(r"(\w+)=", repr(th.planes.cape)))
    text = inspect.getdoc(th.planes.cape)
    assert text.startswith("Cell-wise plane extraction (Proença & Gao, IROS 2018)")
    assert "\nArgs:\n    " in text and "\n    block_px: side of a cell, Proença & Gao; within 4 … 100." in text
    assert "cape" in dir(th.planes)


def test_an_open_slam_prints_as_one_line():
    with th.Slam(ROOM(0).camera, threads=1, outputs=["planes"]) as slam:
        slam.track(ROOM(0).color, ROOM(0).depth_m, 0.0)
        assert repr(slam) == "Slam(160×120, 1 frames, 0 poses)"
        assert repr(slam.values) == f"Values({', '.join(slam.values)})" and "planes" in repr(slam.values)
