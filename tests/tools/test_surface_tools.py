"""Surfaces as files that others read, and judged by a known truth."""

import json
import os
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh

from trihedron.comparison.mesh_distance import FAR_M, NearestTriangle, sample_triangles
from trihedron.comparison.mesh_files import read_mesh
from trihedron.comparison.surface_errors import mesh_errors
from trihedron.comparison.surface_truth import Truth, truth_of
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.core.errors import DataError, UsageError
from trihedron.pipeline.core.geometry import pose_matrix, upright
from trihedron.pipeline.core.types import Camera, Frame, Surface, Trajectory
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.plugins.surface.ply import write_ply
from trihedron.tools import evaluate_surface, export, export_picture

SQUARE = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], float)
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def floor_and_rest(up=(0.0, -1.0, 0.0)):
    """A floor of 2 × 1 m at y = 1 (y down), ahead of the first camera, and a loose triangle."""
    corners = np.array([[-1, 1, 1], [1, 1, 1], [1, 1, 2], [-1, 1, 2], [0, 0, 3], [1, 0, 3], [0, -1, 3]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 6, 5]], np.int32)
    texels = np.array([[[0, 0], [20, 0], [20, 10]], [[0, 0], [20, 10], [0, 10]], [[np.nan] * 2] * 3], np.float32)
    return Surface(
        3, 99, corners, np.full((7, 3), (10, 20, 30), np.uint8), triangles, np.array([0, 0, -1], np.int32), np.array([17], np.int32),
        np.array([[0.0, -1.0, 0.0, 1.0]]), np.array([1], np.uint8), np.array([2.0], np.float32), np.full((1, 3), (200, 0, 0), np.uint8),
        np.array([[0, 0, 4]], np.int32), np.arange(4, dtype=np.int32), np.full((11, 21, 3), (200, 0, 0), np.uint8), texels, np.array(up),
    )  # fmt: skip


def recorded(folder, surface):
    writer = RecordingWriter(folder / "run.mcap", {"overrides": "[]"})
    writer.write("surface", surface)
    writer.close()
    return str(folder)


@pytest.mark.parametrize(("to", "file", "axis"), [("ply", "surface_upright.ply", 2), ("obj", "surface.obj", 2), ("gltf", "surface.glb", 1)])
def test_an_independent_reader_finds_the_mesh_upright_and_in_metres(tmp_path, to, file, axis, capsys):
    assert export.main([recorded(tmp_path, floor_and_rest()), "--to", to]) == 0
    assert "3 triangles, 1 planes" in capsys.readouterr().out
    read = trimesh.load(tmp_path / file, process=False)
    mesh = read.to_geometry() if isinstance(read, trimesh.Scene) else read
    assert len(mesh.faces) == 3 and mesh.area == pytest.approx(2.5)
    assert mesh.bounds[0, axis] == pytest.approx(-1.0) and mesh.bounds[1, axis] == pytest.approx(1.0)  # the floor is below
    level = mesh.triangles[np.ptp(mesh.triangles[:, :, axis], axis=1) < 1e-6]
    facing = np.cross(level[:, 1] - level[:, 0], level[:, 2] - level[:, 0])[:, axis]
    assert len(level) == 2 and (facing < 0.0).all() == (np.cross([2, 0, 0], [2, 0, 1])[1] > 0)  # as wound in the run


def test_gltf_keeps_each_plane_with_its_facts_and_its_picture(tmp_path):
    export.main([recorded(tmp_path, floor_and_rest()), "--to", "gltf", "--out", str(tmp_path / "a.glb")])
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    assert set(scene.geometry) == {"floor_17", "rest"}
    floor = scene.geometry["floor_17"]
    assert floor.visual.material.baseColorTexture.size == (21, 11)
    assert np.ptp(floor.visual.uv, axis=0) == pytest.approx([20 / 21, 10 / 11]) and floor.visual.uv.min() > 0.0
    assert (np.asarray(scene.geometry["rest"].visual.vertex_attributes["color"])[:, :3] == (10, 20, 30)).all()
    data = (tmp_path / "a.glb").read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    assert all(material["extensions"] == {"KHR_materials_unlit": {}} for material in document["materials"]) and len(document["materials"]) == 2
    extras = next(node["extras"] for node in document["nodes"] if node["name"] == "floor_17")
    assert extras["id"] == 17 and extras["kind"] == "floor" and extras["area_m2"] == 2.0 and extras["normal"] == [0.0, 1.0, 0.0]


def corner(island_m=0.1):
    """Floor, two walls and ceiling of a corner 2 m wide and 1 m high, y down, each of two triangles, and a loose square 30 m away."""
    quads = np.array([
        [(0, 1, 0), (2, 1, 0), (2, 1, 2), (0, 1, 2)],
        [(0, 0, 2), (0, 1, 2), (2, 1, 2), (2, 0, 2)],
        [(0, 0, 0), (0, 1, 0), (0, 1, 2), (0, 0, 2)],
        [(0, 0, 0), (0, 0, 2), (2, 0, 2), (2, 0, 0)],
        [(30, 1, 0), (30 + island_m, 1, 0), (30 + island_m, 1, island_m), (30, 1, island_m)],
    ], np.float32)  # fmt: skip
    vertices, rows = np.unique(quads.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = rows.reshape(-1, 4)[:, [0, 2, 1, 0, 3, 2]].reshape(-1, 3)
    inside = np.array([1.0, 0.5, 1.0])
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    away = np.einsum("ij,ij->i", np.cross(b - a, c - a), inside - a) < 0
    triangles[away] = triangles[away][:, ::-1]
    normals = np.array([[0, -1, 0, 1], [0, 0, -1, 2], [1, 0, 0, 0], [0, 1, 0, 0]], float)
    instances = np.repeat([0, 1, 2, 3, -1], 2).astype(np.int32)
    empty = Surface.empty(3, 99)
    return replace(
        empty, vertices_m=vertices, colors=np.full((len(vertices), 3), (10, 20, 30), np.uint8), triangles=triangles.astype(np.int32),
        instances=instances, plane_ids=np.arange(4, dtype=np.int32), coefficients=normals, kinds=np.array([1, 3, 3, 2], np.uint8),
        areas_m2=np.array([4, 2, 2, 4], np.float32), plane_colors=np.zeros((4, 3), np.uint8), up=np.array([0.0, -1.0, 0.0]),
        texels=np.full((10, 3, 2), np.nan, np.float32),
    )  # fmt: skip


def test_the_picture_shows_the_room_without_its_ceiling_and_without_islands():
    picture, count = export_picture.draw_surface(corner(), (320, 200))
    assert picture.shape == (200, 320, 3) and count == 6  # floor and walls
    drawn = (picture != 255).any(axis=2)
    filled = [np.ptp(np.flatnonzero(drawn.any(axis=axis))) / drawn.shape[1 - axis] for axis in (0, 1)]
    assert 0.85 < max(filled) < 0.95
    colors, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
    flat = colors[np.argsort(-counts)[:4]].astype(int)  # paper and three planes
    assert min(np.abs(a - b).max() for i, a in enumerate(flat) for b in flat[:i]) > 25
    assert export_picture.draw_surface(corner(island_m=2.0), (32, 20))[1] == 8
    assert (export_picture.draw_surface(Surface.empty(0, 0))[0] == np.full((1200, 1920, 3), 255)).all()


def flat_colors(surface):
    """The colours of the picture that cover more than a twentieth of what is drawn, without light."""
    picture, _ = export_picture.draw_surface(surface, (320, 200))
    colors, counts = np.unique(picture[(picture != 255).any(axis=2)], axis=0, return_counts=True)
    return {tuple(color) for color in colors[counts > 0.05 * counts.sum()]}


def test_planes_that_continue_each_other_share_a_colour():
    room = corner()
    floor = np.array([0, -1, 0, 1.0])
    halves = replace(room, instances=np.array([0, 4, 1, 1, 2, 2, 3, 3, -1, -1], np.int32), plane_ids=np.arange(5, dtype=np.int32),
        coefficients=np.vstack([room.coefficients, floor]), kinds=np.append(room.kinds, np.uint8(1)),
        areas_m2=np.append(room.areas_m2, np.float32(2)), plane_colors=np.zeros((5, 3), np.uint8))  # fmt: skip
    assert len(flat_colors(room)) == len(flat_colors(halves)) == 3
    step = np.vstack([[0, -1, 0, 1.05], halves.coefficients[1:]])
    assert len(flat_colors(replace(halves, coefficients=step))) == 4


def test_what_hangs_on_the_ceiling_alone_is_an_island():
    room = corner()
    count = len(room.vertices_m)
    lamp = np.array([[1, 0, 1], [1.1, 0, 1], [1, 0.2, 1]], np.float32)
    added = np.array([[count, count + 1, count + 2], [room.triangles[6, 0], count, count + 1]], np.int32)  # below the ceiling, and a part of it
    hanging = replace(
        room, vertices_m=np.vstack([room.vertices_m, lamp]), colors=np.zeros((count + 3, 3), np.uint8),
        triangles=np.vstack([room.triangles, added]), instances=np.append(room.instances, np.array([-1, 3], np.int32)),
        texels=np.full((12, 3, 2), np.nan, np.float32),
    )  # fmt: skip
    assert export_picture.draw_surface(hanging, (32, 20))[1] == 6


def test_specks_of_the_picture_are_dropped():
    drawn = np.zeros((40, 60), bool)
    drawn[5:35, 5:35] = True
    drawn[20, 50:53] = True
    assert (export_picture.remove_specks(drawn) == (drawn & (np.arange(60) < 40))).all()


def test_a_picture_has_the_colours_of_the_images_by_an_option(tmp_path, capsys):
    run = recorded(tmp_path, corner())
    for words, colors in ([], "planes"), (["--images"], "images"):
        assert export.main([run, "--to", "png", *words]) == 0
        expected = f"{tmp_path}/surface.png: 1920 × 1200 px, 6 triangles below the ceiling in the colours of the {colors}\n"
        assert capsys.readouterr().out == expected
    picture = cv2.imread(str(tmp_path / "surface.png"))[..., ::-1].astype(float)
    drawn = picture[(picture != 255).any(axis=2)]
    assert np.allclose(np.median(drawn / drawn[:, 2:], axis=0), (np.array([10, 20, 30]) / 30) ** 0.6, atol=0.02)  # lifted
    with pytest.raises(UsageError, match="--images is not for the format 'ply'; give --to png, or leave out --images"):
        export.main([run, "--to", "ply", "--images"])


def test_planes_json_holds_identity_boundary_and_equation(tmp_path):
    export.main([recorded(tmp_path, floor_and_rest()), "--to", "planes.json"])
    plane = json.loads((tmp_path / "planes.json").read_text())["planes"][0]
    assert (plane["id"], plane["kind"], plane["area_m2"], plane["color"]) == (17, "floor", 2.0, [200, 0, 0])
    ring = np.array(plane["boundary"][0])
    assert np.allclose(ring @ plane["normal"] + plane["d"], 0.0) and len(ring) == 4 and np.allclose(plane["normal"], [0, 0, 1])


def test_up_is_the_manhattan_axis_or_said_to_be_a_guess(tmp_path, capsys):
    for axis in ("y", "z"):
        for up in (np.array([0.0, -1.0, 0.0]), np.array([0.1, -0.99, 0.05]), np.array([0.0, 0.0, -1.0])):
            R = upright(up, axis)
            assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) == pytest.approx(1.0)
            assert np.allclose(R @ up / np.linalg.norm(up), np.eye(3)["xyz".index(axis)])
    export.main([recorded(tmp_path, floor_and_rest((np.nan,) * 3)), "--to", "ply"])
    assert "first camera's up" in capsys.readouterr().out


@pytest.mark.parametrize("to", ["ply", "obj", "gltf", "planes.json", "png"])
def test_an_empty_surface_is_a_valid_file_and_said_to_be_empty(tmp_path, to, capsys):
    export.main([recorded(tmp_path, Surface.empty(0, 0)), "--to", to, "--out", str(tmp_path / "file")])
    assert "empty" in capsys.readouterr().out and (tmp_path / "file").stat().st_size > 20


def test_mistakes_of_export_are_one_line(tmp_path):
    with pytest.raises(UsageError, match=r"planes\.json"):
        export.main([str(tmp_path), "--to", "planesjson"])
    writer = RecordingWriter(tmp_path / "run.mcap", {"overrides": "[]"})
    writer.close()
    with pytest.raises(DataError, match="holds no surface"):
        export.main([str(tmp_path), "--to", "ply"])


def square_truth():
    nearest, seen = NearestTriangle(SQUARE, TWO), sample_triangles(SQUARE, TWO, 0.02)[0]

    def distance(points):
        return nearest.query(points)[0], points[:, 0] > 1.0

    return Truth(distance, seen, seen[:, 0] > 1.0, True)


def test_figures_of_a_mesh_that_is_a_centimetre_off_and_half_there():
    half = SQUARE * [0.5, 1.0, 1.0] + [0.0, 0.0, 0.01]
    found = mesh_errors(half, TWO, square_truth())
    assert found["triangles"] == 2 and found["area_m2"] == pytest.approx(1.0)
    planar, curved, whole = (found["parts"][part] for part in ("planar", "curved", "all"))
    for name in ("mean_m", "rmse_m", "p95_m"):
        assert planar[name] == pytest.approx(0.01, abs=1e-9)
    assert planar["within_2_cm"] == 1.0 and curved["mean_m"] is None
    assert curved["within_5_cm"] == pytest.approx(0.05, abs=0.02) and whole["within_2_cm"] == pytest.approx(0.51, abs=0.02)


def test_area_counts_not_the_number_of_triangles():
    many = np.concatenate([SQUARE + np.array([0.0, 0.0, 0.03]), SQUARE * 0.1 + np.array([0.5, 0.5, 0.0])])
    tiny = TWO + 4
    found = mesh_errors(many, np.concatenate([TWO, *[tiny] * 50]), square_truth())["parts"]["all"]
    assert found["mean_m"] == pytest.approx(0.03 * 2.0 / 3.0, rel=1e-3)


def test_distances_to_triangles_are_exact():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.4, 0.4, (500, 3)) + np.array([1.0, 0.5, 0.0])
    nearest = np.clip(points, [0, 0, 0], [2, 1, 0])
    found, triangle = NearestTriangle(SQUARE, TWO).query(points)
    assert np.allclose(found, np.linalg.norm(points - nearest, axis=1), atol=1e-12) and set(triangle) == {0, 1}
    assert NearestTriangle(SQUARE, TWO).query(np.array([[9.0, 9.0, 9.0]]))[0][0] == FAR_M


def test_an_empty_mesh_is_judged_too():
    found = mesh_errors(np.empty((0, 3)), np.empty((0, 3), np.int32), square_truth())["parts"]["all"]
    assert found["mean_m"] is None and found["within_5_cm"] == 0.0


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_meshes_of_other_programs_are_read(tmp_path, suffix):
    mesh = trimesh.Trimesh(SQUARE, TWO, process=False)
    mesh.export(tmp_path / f"m.{suffix}")
    vertices, triangles = read_mesh(tmp_path / f"m.{suffix}")
    assert np.allclose(vertices, SQUARE) and np.array_equal(triangles, TWO)
    (tmp_path / f"bad.{suffix}").write_text("ply\nnonsense")
    if suffix == "ply":
        with pytest.raises(DataError, match="is not a mesh"):
            read_mesh(tmp_path / "bad.ply")
    os.mkfifo(tmp_path / f"pipe.{suffix}")
    with pytest.raises(DataError, match=r"is not a mesh: .*it is not a regular file"):
        read_mesh(tmp_path / f"pipe.{suffix}")


def test_polygons_and_indices_from_the_end_and_materials_elsewhere(tmp_path):
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv -1 0.5 0\n"
    (tmp_path / "m.obj").write_text(f"mtllib ../../etc/passwd\n{corners}f -5 -4 -3 -2 -1\n")
    vertices, triangles = read_mesh(tmp_path / "m.obj")
    assert len(vertices) == 5 and triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    (tmp_path / "m.obj").write_text(f"{corners}f 1 2 9\n")
    with pytest.raises(DataError, match=r"m\.obj: "):
        read_mesh(tmp_path / "m.obj")
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "m.ply").write_text(head)
    with pytest.raises(DataError, match=r"m\.ply: is not a mesh: "):
        read_mesh(tmp_path / "m.ply")


def test_truth_that_cannot_be_had_is_one_line(tmp_path):
    write_ply(tmp_path / "surface.ply", SQUARE.astype(np.float32), np.zeros((4, 3), np.uint8), TWO, np.zeros(2, np.int32), "")
    (tmp_path / "trajectory.txt").write_text("0.0 0 0 0 0 0 0 1\n")
    RecordingWriter(tmp_path / "run.mcap", {"overrides": "[]"}).close()
    with pytest.raises(DataError, match="holds no ground truth"):
        evaluate_surface.main([str(tmp_path)])
    with pytest.raises(DataError, match="there is no such file"):
        evaluate_surface.main([str(tmp_path / "none.ply"), str(tmp_path)])


@pytest.mark.parametrize("curved", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_true_surface_of_the_room_is_what_its_depth_shows(curved):
    dataset = Synthetic(width=80, height=60, noise=False, texture=False, curved=curved, length=300)
    surface, frame, T = dataset.surface(), dataset(250), dataset.truth().poses[250]
    depth, bent = dataset.true_view(250)
    v, u = np.mgrid[0:60, 0:80].reshape(2, -1)
    points = frame.camera.back_project(np.stack([u, v], axis=1), depth[v, u]) @ T[:3, :3].T + T[:3, 3]
    off, triangle = NearestTriangle(surface.vertices_m, surface.triangles).query(points)
    assert off.max() < 0.005 and (surface.curved[triangle] == bent[v, u]).mean() > 0.99
    assert (bent.mean() > 0.2) == curved
    assert np.array_equal(depth.astype(np.float32), frame.depth_m)


class SquareBefore:
    """A camera 2 m before the middle of the square; its right half counts as curved."""

    camera = Camera(80, 60, 150.0, 150.0, 39.5, 29.5)

    def __len__(self):
        return 1

    def __call__(self, position):
        return Frame(0, 0, np.zeros((60, 80, 3), np.uint8), np.full((60, 80), 2.0, np.float32), self.camera)


class SquareWithSurface(SquareBefore):
    def surface(self):
        triangles = np.array([[0, 4, 5], [0, 5, 3], [4, 1, 2], [4, 2, 5]], np.int32)
        vertices = np.concatenate([SQUARE, [[1, 0, 0], [1, 1, 0]]])
        return SimpleNamespace(vertices_m=vertices, triangles=triangles, curved=np.array([False, False, True, True]))

    def true_view(self, position):
        return np.full((60, 80), 2.0), np.tile(np.arange(80) > 39, (60, 1))


@pytest.mark.parametrize("kind", [SquareBefore, SquareWithSurface])
def test_truth_is_the_distance_to_a_surface_also_where_only_depth_is_exact(kind):
    T = pose_matrix(np.eye(3), np.array([1.0, 0.5, -2.0]))
    truth = truth_of(kind(), Trajectory(np.zeros(1, np.int64), T[None]))
    points = np.array([[0.8, 0.4, -0.01], [1.2, 0.6, -0.01], [1.0, 0.5, 0.02]]) + 0.004
    off, curved = truth.distance(points)
    assert np.allclose(off, [0.006, 0.006, 0.024], atol=1e-6) and np.allclose(truth.seen_m[:, 2], 0.0, atol=1e-6)
    assert truth.labelled == (kind is SquareWithSurface)
    assert curved[:2].tolist() == ([False, True] if truth.labelled else [False, False])
    assert np.array_equal(truth.curved, truth.seen_m[:, 0] > 1.0) or not truth.labelled


def test_the_curved_pieces_are_for_the_room():
    from trihedron.datasets.simulation.synthetic import Scene

    with pytest.raises(ValueError, match="curved"):
        Synthetic(scene=Scene.corridor, curved=True)
    plain = Synthetic(width=80, height=60, length=5, texture=False)
    more = replace(plain, curved=True)
    assert len(more.surface().triangles) > len(plain.surface().triangles) and np.array_equal(plain.truth().poses, more.truth().poses)
