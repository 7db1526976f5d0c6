"""Surfaces of scenes with known planes: where they are, that they are whole, and that nothing seen is no error."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from trihedron.pipeline.core.registry import load_plugins, plugin_class, plugins_of
from trihedron.pipeline.core.types import EXACT_DEPTH, LOST, PLANE_KINDS, Camera
from trihedron.pipeline.record.codec import Encoder
from trihedron.plugins.surface.files import write_surface
from trihedron.plugins.surface.half_edges import opposite_half_edges
from trihedron.plugins.surface.outlines import close_pinholes

sys.path.insert(0, str(Path(__file__).parent))
from surface_world import BACK, BALL, FLOOR, LEFT, RADIUS, faults, fold, off_truth, render, seen, walk

load_plugins()
SURFACES = tuple(name for name in plugins_of("surface") if name != "none")
SLOW_POISSON = [pytest.param(name, marks=pytest.mark.slow if name == "open3d_poisson" else ()) for name in SURFACES]
DENSE = ("tsdf", "open3d_voxels", "open3d_poisson")  # two triangles or more a cell of 2 cm, also where it is flat: 55 000 on 11 m²


@cache
def corner(name):
    return fold(plugin_class("surface", name)(view_width=160), [seen(k, T) for k, T in enumerate(walk())])


@pytest.mark.parametrize(
    ("name", "mean_m", "facing"),
    [
        ("tsdf", 0.003, 0.995),
        ("planar_tsdf", 0.003, 0.995),
        ("planar_polygon", 0.001, 0.995),
        ("planar_greedy", 0.001, 0.995),
        ("surfels", 0.02, 0.995),
        ("open3d_voxels", 0.01, 0.97),
        pytest.param("open3d_poisson", 0.001, 0.99, marks=pytest.mark.slow),
    ],
)
def test_a_corner_with_a_ball(name, mean_m, facing):
    surface = corner(name)
    assert len(surface.triangles) > 10 and off_truth(surface).mean() < mean_m
    assert (np.abs(surface.colors.astype(int) - (200, 100, 50)).max(axis=1) <= 1).mean() > 0.95
    middles = surface.vertices_m[surface.triangles]
    normals = np.cross(middles[:, 1] - middles[:, 0], middles[:, 2] - middles[:, 0])
    towards = ((walk()[4][:3, 3] - middles.mean(axis=1)) * normals).sum(axis=1) > 0.0
    assert np.average(towards, weights=np.linalg.norm(normals, axis=1)) > facing


@pytest.mark.parametrize("name", ["planar_tsdf", "planar_polygon", "planar_greedy"])
def test_planes_are_known_by_what_they_are(name):
    surface = corner(name)
    assert np.allclose(surface.up, [0.0, -1.0, 0.0])  # the Manhattan frame's, not the tilted camera's
    kinds = {PLANE_KINDS[k]: row for row, k in enumerate(surface.kinds)}
    assert set(kinds) == {"floor", "wall"} and len(surface.plane_ids) == 3 == len(set(surface.plane_ids))
    for expected in (FLOOR, LEFT, BACK):
        assert np.abs(surface.coefficients - expected).max(axis=1).min() < 0.004
    corners = surface.vertices_m.astype(float)[surface.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    for row in range(3):
        assert surface.areas_m2[row] == pytest.approx(area[surface.instances == row].sum(), rel=1e-4)
    assert np.abs(surface.plane_colors.astype(int) - (200, 100, 50)).max() <= 1
    texels = surface.texels[surface.instances >= 0]
    assert np.isfinite(texels).all() and texels.min() >= 0.0 and (texels.max(axis=(0, 1)) < surface.atlas.shape[1::-1]).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["planar_tsdf", "planar_polygon", "planar_greedy"])
def test_without_a_manhattan_frame_nobody_knows_what_is_a_floor(name):
    inputs = [(frame, planes, None, pose) for frame, planes, _, pose in (seen(k, T) for k, T in enumerate(walk()))]
    surface = fold(plugin_class("surface", name)(view_width=160), inputs)
    assert np.isnan(surface.up).all() and len(surface.plane_ids) == 3
    assert [PLANE_KINDS[k] for k in surface.kinds] == ["plane"] * 3


@pytest.mark.parametrize("name", ["planar_tsdf", "planar_polygon"])
def test_the_mesh_is_whole_and_nothing_is_turned_over(name):
    assert set(faults(corner(name)).values()) == {0}


def test_the_counts_of_faults_see_faults():
    surface = corner("planar_polygon")
    turned = surface.triangles.copy()
    turned[:5] = turned[:5, ::-1]
    assert faults(replace(surface, triangles=turned))["backwards"] >= 4
    doubled = {name: np.concatenate([getattr(surface, name), getattr(surface, name)[:1]]) for name in ("triangles", "instances", "texels")}
    found, opposite = faults(replace(surface, **doubled)), opposite_half_edges(surface.triangles)
    assert found["same way"] == 3 and found["crowded"] == (opposite[:3] >= 0).sum() > 0
    apart = {"vertices_m": surface.vertices_m[surface.triangles.ravel()], "colors": surface.colors[surface.triangles.ravel()]}
    loose = replace(surface, **apart, triangles=np.arange(surface.triangles.size, dtype=np.int32).reshape(-1, 3))
    assert faults(loose)["cracks"] == (opposite >= 0).sum() // 2 > 10
    edge = int(np.flatnonzero(opposite[:3] >= 0)[0])
    begin, end, far = np.roll(surface.triangles[0], -edge)
    middle = surface.vertices_m[[begin, end]].mean(axis=0, keepdims=True)
    half = {name: np.concatenate([getattr(surface, name), getattr(surface, name)[:1]]) for name in ("instances", "texels")}
    corner_of = np.concatenate([[[begin, len(surface.vertices_m), far]], surface.triangles[1:], [[len(surface.vertices_m), end, far]]])
    cut = replace(
        surface, **half, triangles=corner_of.astype(np.int32), vertices_m=np.concatenate([surface.vertices_m, middle]),
        colors=np.concatenate([surface.colors, surface.colors[:1]]),
    )  # fmt: skip
    assert faults(cut)["T-junctions"] == (opposite[edge] >= 0) == 1


def test_small_rings_of_open_edges_are_closed_and_large_ones_stay():
    """A sheet of squares of 4 mm: a triangle and a square taken out are put back the right way round, the sheet's own rim stays."""
    rows, columns = np.mgrid[0:9, 0:9]
    points = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3) * 0.004
    place = (rows * 9 + columns)[:8, :8].ravel()
    sheet = np.concatenate([np.stack([place, place + 1, place + 10], 1), np.stack([place, place + 10, place + 9], 1)]).astype(np.int32)
    holed = np.delete(sheet, [10, 36, 36 + 64], axis=0)
    whole, owners = close_pinholes(points, holed, np.arange(len(holed), dtype=np.int32) // 64)
    assert len(whole) == len(owners) == len(sheet) and set(owners.tolist()) == {0, 1}
    normals = np.cross(points[whole[:, 1]] - points[whole[:, 0]], points[whole[:, 2]] - points[whole[:, 0]])
    assert (normals[:, 2] > 0.0).all() and np.isclose(0.5 * normals[:, 2].sum(), 0.032**2)
    assert (opposite_half_edges(whole) < 0).sum() == 32


@pytest.mark.parametrize("name", ["planar_tsdf", "planar_polygon"])
def test_planes_meet_along_the_lines_where_they_intersect(name):
    """The mesh is closed where floor and walls meet: shared edges, on both planes to 0.1 mm, as long as the seen part of the lines."""
    surface = corner(name)
    opposite, t = opposite_half_edges(surface.triangles), surface.triangles
    h = np.flatnonzero(opposite >= 0)
    one, other = surface.instances[h // 3], surface.instances[opposite[h] // 3]
    between = h[(one >= 0) & (other >= 0) & (one < other)]
    ends = surface.vertices_m.astype(float)[np.stack([t.ravel()[between], t[:, [1, 2, 0]].ravel()[between]], axis=1)]
    for k in (0, 1):
        for row in (one[np.isin(h, between)], other[np.isin(h, between)]):
            plane = surface.coefficients[row]
            assert np.abs((ends[:, k] * plane[:, :3]).sum(axis=1) + plane[:, 3]).max() < 1e-4
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    pairs = np.sort(np.stack([one[np.isin(h, between)], other[np.isin(h, between)]], axis=1), axis=1)
    total = {tuple(pair): length[(pairs == pair).all(axis=1)].sum() for pair in np.unique(pairs, axis=0)}
    assert len(total) == 3 and min(total.values()) > 1.0  # metres


def test_the_ball_is_joined_to_the_floor():
    """planar_tsdf closes the seam: each triangle edge between a plane and the rest has exactly one triangle on either side."""
    surface = corner("planar_tsdf")
    opposite = opposite_half_edges(surface.triangles)
    h = np.flatnonzero((opposite >= 0) & (surface.instances[np.arange(len(opposite)) // 3] < 0))
    seam = h[surface.instances[opposite[h] // 3] >= 0]
    assert len(seam) > 20
    on_ball = np.abs(np.linalg.norm(surface.vertices_m[surface.triangles[surface.instances < 0]].astype(float) - BALL, axis=-1) - RADIUS)
    assert np.median(on_ball) < 0.003


def test_polygons_take_far_fewer_triangles():
    assert len(corner("planar_polygon").triangles) < 0.02 * len(corner("tsdf").triangles)
    for plane, begin, end in corner("planar_polygon").loops:
        ring = corner("planar_polygon").vertices_m[corner("planar_polygon").loop_vertices[begin:end]].astype(float)
        n = corner("planar_polygon").coefficients[plane]
        assert len(ring) >= 3 and np.abs(ring @ n[:3] + n[3]).max() < 1e-4


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name.startswith("open3d") else ()) for name in SURFACES])
def test_the_same_frames_give_the_same_bytes(name):
    again = fold(plugin_class("surface", name)(view_width=160), [seen(k, T) for k, T in enumerate(walk())])
    assert Encoder().encode(again) == Encoder().encode(corner(name))


@pytest.mark.parametrize("name", SLOW_POISSON)
@pytest.mark.parametrize("case", ["nothing", "lost", "no depth", "NaN", "one plane", "edge-on", "a million points"])
def test_degenerate_input_gives_a_valid_file(name, case, tmp_path):
    T, large = np.eye(4), Camera(1280, 960, 1000.0, 1000.0, 639.5, 479.5, depth_noise=EXACT_DEPTH)
    inputs = {
        "nothing": [],
        "lost": [seen(0, T, status=LOST)],
        "no depth": [seen(0, T, (), ball=False)],
        "NaN": [seen(0, T, depth=np.where(np.arange(160) % 2, np.nan, render(T, (FLOOR, LEFT, BACK))[0]))],
        "one plane": [seen(k, T, (BACK,), ball=False) for k in range(3)],
        "edge-on": [seen(k, T, ((0.0, -1.0, 0.0, 1e-4),), ball=False) for k in range(3)],
        "a million points": [seen(0, T, (BACK,), ball=False, camera=large)],
    }[case]
    surface = fold(plugin_class("surface", name)(), inputs)
    (said,) = write_surface(tmp_path, surface)
    assert ("empty" in said) == (len(surface.triangles) == 0) and ("triangles" in said) == (len(surface.triangles) > 0)
    if case in ("nothing", "lost", "no depth"):
        assert len(surface.triangles) == len(surface.vertices_m) == len(surface.plane_ids) == 0
    else:
        read = trimesh.load(tmp_path / "surface.ply", process=False)
        assert len(getattr(read, "faces", [])) == len(surface.triangles)
        assert np.isfinite(surface.vertices_m).all()
    if case in ("one plane", "a million points") and name not in ("surfels", "superpixels"):  # one view is none to them
        assert np.abs(surface.vertices_m[:, 2] - 3.0).max() < 0.002 and len(surface.triangles) >= 2
        assert case == "one plane" or name in DENSE or len(surface.triangles) < 20_000


@pytest.mark.parametrize("name", [param for param in SLOW_POISSON if param.values[0] in DENSE])
def test_one_view_gives_the_area_that_it_shows(name):
    surface = fold(plugin_class("surface", name)(), [seen(0, np.eye(4), (BACK,), ball=False)])
    corners = surface.vertices_m.astype(float)[surface.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert area == pytest.approx(159 / 130 * 3.0 * 119 / 130 * 3.0, rel=0.05)


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("tsdf", {"voxel_m": 0.0}, "voxel_m"),
        ("planar_tsdf", {"rim_m": 0.001}, "rim_m"),
        ("planar_polygon", {"snap_m": 0.0}, "snap_m"),
        ("planar_greedy", {"multiplier": 1.0}, "multiplier"),
        ("surfels", {"side_px": 30}, "side_px"),
        ("surfels", {"min_novelty": 0.0}, "min_novelty"),
    ],
)
def test_options_out_of_range_are_refused(name, options, said):
    with pytest.raises(ValueError, match=said):
        plugin_class("surface", name)(**options)


def test_a_preview_is_the_mesh_so_far():
    """Viewers are shown what is fused; the fold goes on, and ends with the same bytes."""
    plugin, inputs = plugin_class("surface", "planar_tsdf")(view_width=160), [seen(k, T) for k, T in enumerate(walk())]
    state = plugin.start()
    assert len(plugin.preview(state).triangles) == 0
    counts = []
    for given in inputs:
        state = plugin.add(state, *given, None)
        counts.append(len(plugin.preview(state).triangles))
    assert counts[0] > 1000 and counts[-1] > counts[0]
    assert Encoder().encode(plugin.finish(state, None)) == Encoder().encode(corner("planar_tsdf"))
