"""The readers of folders: what they make of good input."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from trihedron.datasets.readers.folder import Folder
from trihedron.datasets.readers.icl_nuim import IclNuim, reflect
from trihedron.datasets.readers.tum import Tum
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import EXACT_DEPTH, DepthNoise


def test_tum_pairs_by_time_and_keeps_the_stamp_of_colour(tum_folder: Path) -> None:
    dataset = Tum(path=str(tum_folder))
    assert len(dataset) == 4
    frame = dataset(3)
    assert frame is not None
    assert (frame.index, frame.stamp_ns) == (3, 10_300_000_000)
    assert (frame.color == np.array([200, 100, 10])).all()  # RGB
    assert frame.depth_m.dtype == np.float32 and (frame.depth_m == 2.0).all()
    assert frame.camera.depth_noise == DepthNoise()
    truth = dataset.truth()
    assert truth is not None
    assert truth.stamps_ns.tolist() == [10_000_000_000, 10_100_000_000, 10_200_000_000]
    np.testing.assert_array_equal(truth.poses[:, 0, 3], [0.0, 1.0, 2.0])


def test_ground_truth_may_be_absent_and_depth_exact(tum_folder: Path) -> None:
    (tum_folder / "groundtruth.txt").unlink()
    dataset = Tum(path=str(tum_folder), exact_depth=True)
    assert dataset.truth() is None
    frame = dataset(0)
    assert frame is not None and frame.camera.depth_noise == EXACT_DEPTH


def test_frames_is_a_half_open_range_of_the_whole_data_set(tum_folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    dataset = Tum(path=str(tum_folder), frames="1:3")
    frames = [dataset(0), dataset(1)]
    assert len(dataset) == 2
    assert [(f.index, f.stamp_ns) for f in frames if f] == [(1, 10_100_000_000), (2, 10_200_000_000)]
    strided = Tum(path=str(tum_folder), frames="1::2")
    assert [(f.index, f.stamp_ns) for f in map(strided, range(len(strided))) if f] == [(1, 10_100_000_000), (3, 10_300_000_000)]
    assert len(Tum(path=str(tum_folder), frames=":2")) == 2
    with caplog.at_level(logging.WARNING, logger="trihedron"):
        assert len(Tum(path=str(tum_folder), frames="2:9")) == 2
    assert caplog.messages == [f"dataset.frames: '2:9' ends beyond the 4 frames of {tum_folder}"]


@pytest.mark.parametrize("damage", ["truncated", "garbled", "empty", "truncated jpeg"])
def test_an_unreadable_image_is_one_warning_and_no_frame(tum_folder: Path, caplog: pytest.LogCaptureFixture, damage: str) -> None:
    file = tum_folder / "rgb/10.100000.png"
    data = file.read_bytes()
    causes = {
        "truncated": (data[: len(data) // 2], "is truncated"),
        "garbled": (data[:40] + bytes(30) + data[70:], "is damaged ("),
        "empty": (b"", "is empty"),
        "truncated jpeg": (cv2.imencode(".jpg", np.zeros((24, 32, 3), dtype=np.uint8))[1].tobytes()[:-40], "is truncated"),
    }
    file.write_bytes(causes[damage][0])
    dataset = Tum(path=str(tum_folder))
    with caplog.at_level(logging.WARNING, logger="trihedron"):
        assert dataset(1) is None
    (message,) = caplog.messages
    assert message.startswith(f"{file}: {causes[damage][1]}") and message.endswith("; frame 1 is skipped")
    assert dataset(0) is not None


def test_colour_images_without_depth_are_counted(tum_folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    lines = (tum_folder / "depth.txt").read_text().splitlines(keepends=True)
    (tum_folder / "depth.txt").write_text("".join(lines[:-1]))
    assert len(Tum(path=str(tum_folder))) == 3
    assert caplog.messages == [f"{tum_folder}: 1 of the 4 colour images have no depth image within 20 ms; they are skipped"]


def test_a_list_that_names_more_images_than_there_are_ends_with_one_warning(tum_folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    with (tum_folder / "rgb.txt").open("a") as file:
        file.writelines(f"{10.4 + k / 10:.6f} rgb/{k}.png\n" for k in range(50))
    dataset = Tum(path=str(tum_folder))
    assert len(dataset) == 4 and dataset(3) is not None
    assert caplog.messages == [f"{tum_folder}/rgb.txt: 50 of the 54 images it names are missing, the first is 0.png; they are skipped"]
    for image in (tum_folder / "rgb").iterdir():
        image.unlink()
    with pytest.raises(DataError, match=r"rgb.txt: names 54 images, of which none is there; unpack the images beside the list$"):
        len(Tum(path=str(tum_folder)))


def test_a_known_distorted_point_lands_where_the_pinhole_camera_sees_it(tmp_path: Path) -> None:
    """Brown's model written out: the image of an ideal point is drawn where the lens puts it, and found where the pinhole would."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = 517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633
    ideal = np.array([[100, 90], [320, 250], [560, 400], [70, 430]])
    color, depth = np.zeros((480, 640, 3), dtype=np.uint8), np.full((480, 640), 5000, dtype=np.uint16)
    moved = []
    for u, v in ideal:
        x, y = (u - cx) / fx, (v - cy) / fy
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        ud, vd = fx * xd + cx, fy * yd + cy
        moved.append(np.hypot(ud - u, vd - v))
        cv2.circle(color, (round(16 * ud), round(16 * vd)), 4 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
        cv2.circle(depth, (round(ud), round(vd)), 4, 10000, -1)
    assert max(moved) > 5.0
    folder = tmp_path / "rgbd_dataset_freiburg1_test"
    for name, image in (("rgb", color), ("depth", depth)):
        (folder / name).mkdir(parents=True)
        cv2.imwrite(str(folder / name / "1.000000.png"), image)
        (folder / f"{name}.txt").write_text(f"1.000000 {name}/1.000000.png\n")
    frame = Tum(path=str(folder))(0)
    assert frame is not None and frame.camera.fx == fx
    for u, v in ideal:
        window = frame.color[v - 10 : v + 11, u - 10 : u + 11, 0].astype(float)
        yy, xx = np.mgrid[-10:11, -10:11]
        assert np.hypot((window * xx).sum() / window.sum(), (window * yy).sum() / window.sum()) < 0.15
        assert frame.depth_m[v, u] == 2.0
    assert set(np.unique(frame.depth_m)) <= {0.0, 1.0, 2.0}  # no depth in between


def test_folder_takes_numbers_for_frame_numbers_in_natural_order(plain_folder: Path) -> None:
    dataset = Folder(path=str(plain_folder))
    frames = [dataset(i) for i in range(len(dataset))]
    assert [f.stamp_ns for f in frames if f] == [400_000_000, 450_000_000, 500_000_000]  # 8, 9, 10 at 20 frames/s
    assert dataset.truth() is None


def rename(folder: Path, colors: list[str], depths: list[str]) -> None:
    for name, new in (("color", colors), ("depth", depths)):
        for old, stem in zip(["8", "9", "10"], new):
            (folder / name / f"{old}.png").rename(folder / name / f"{stem}.png")


@pytest.mark.parametrize(
    ("colors", "depths", "expected"),
    [
        (["5.25", "5.50", "6.00"], ["5.25", "5.50", "6.00"], [5_250_000_000, 5_500_000_000, 6_000_000_000]),
        (["5.25", "5.50", "6.00"], ["5.10", "5.26", "5.99"], [5_250_000_000, 6_000_000_000]),
        (["1700000000123", "1700000000223", "1700000000323"], ["a1", "a2", "a3"], [1_700_000_000_123_000_000 + i * 10**8 for i in range(3)]),
        (["color_2", "color_10", "color_9"], ["depth_1", "depth_5", "depth_7"], [0, 50_000_000, 100_000_000]),
    ],
    ids=["seconds", "seconds that differ", "milliseconds since 1970", "words"],
)
def test_folder_reads_stamps_off_names(plain_folder: Path, colors: list[str], depths: list[str], expected: list[int]) -> None:
    rename(plain_folder, colors, depths)
    dataset = Folder(path=str(plain_folder))
    assert [dataset(i).stamp_ns for i in range(len(dataset))] == expected


PLANE = np.array([0.25, -0.35, -0.9, 3.0])  # world, y down
SHORT_CAMERA = "width: 64\nheight: 48\nfx: 60.0\nfy: 60.0\ncx: 31.5\ncy: 23.5\ndepth_scale: 5000\nfps: 30\n"


def made_up_icl() -> tuple[np.ndarray, list[np.ndarray]]:
    """Two poses (y down) and the depth of a slanted plane seen from each, 64 × 48."""
    poses = np.array([np.eye(4), exp_se3(np.array([0.2, -0.3, 0.1, 0.15, -0.1, 0.2]))])
    y, x = np.mgrid[:48, :64]
    rays = np.stack([(x - 31.5) / 60.0, (y - 23.5) / 60.0, np.ones_like(x, dtype=float)], axis=-1)
    depths = [-(PLANE[:3] @ T[:3, 3] + PLANE[3]) / ((rays @ T[:3, :3].T) @ PLANE[:3]) for T in poses]
    assert all((d > 0.5).all() for d in depths)
    return poses, depths


def write_tum_compatible(folder: Path, poses: np.ndarray, depths: list[np.ndarray]) -> None:
    """Images 0, 1, 2 of which 1 and 2 have a pose, as published: y up, keyed by number."""
    from trihedron.pipeline.core.types import Trajectory
    from trihedron.pipeline.record.trajectories import write_trajectory

    for number, depth in enumerate([depths[0], *depths]):
        for name, image in (("rgb", np.zeros((48, 64, 3), dtype=np.uint8)), ("depth", np.rint(depth * 5000).astype(np.uint16))):
            (folder / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / name / f"{number}.png"), image)
    write_trajectory(folder / "traj9.gt.freiburg", Trajectory(np.array([1, 2]) * 1_000_000_000, reflect(poses)))
    (folder / "camera.yaml").write_text(SHORT_CAMERA)


def write_povray(folder: Path, poses: np.ndarray, depths: list[np.ndarray]) -> None:
    """The same as POV-Ray writes it: distances along the ray and positions in centimetres, y up."""
    folder.mkdir()
    y, x = np.mgrid[:48, :64]
    stretch = np.sqrt(1 + ((x - 31.5) / 60.0) ** 2 + ((y - 23.5) / 60.0) ** 2)
    for number, (T, depth) in enumerate(zip(reflect(poses), depths)):
        stem = folder / f"scene_00_{number:04d}"
        cv2.imwrite(f"{stem}.png", np.zeros((48, 64, 3), dtype=np.uint8))
        Path(f"{stem}.depth").write_text(" ".join(f"{v:.6f}" for v in (100 * depth * stretch).ravel()))
        rows = {"cam_pos": 100 * T[:3, 3], "cam_dir": T[:3, 2], "cam_up": T[:3, 1], "cam_right": 1.33 * T[:3, 0]}
        lines = [f"{key:12} = [{v[0]:.9f}, {v[1]:.9f}, {v[2]:.9f}]';" for key, v in rows.items()]
        Path(f"{stem}.txt").write_text("\n".join([*lines, "cam_angle    = 90;"]) + "\n")
    (folder / "camera.yaml").write_text(SHORT_CAMERA)


@pytest.mark.parametrize(("write", "first"), [(write_tum_compatible, 1), (write_povray, 0)])
def test_icl_layouts_agree_with_the_scene_they_show(tmp_path: Path, warp_error_m: Callable[..., float], write: Callable, first: int) -> None:
    poses, depths = made_up_icl()
    write(tmp_path / "icl", poses, depths)
    dataset = IclNuim(path=str(tmp_path / "icl"), exact_depth=True)
    assert len(dataset) == 2 + first  # image 0 of the TUM-compatible layout is a frame without truth
    truth, frames = dataset.truth(), [dataset(first), dataset(first + 1)]
    assert truth is not None
    np.testing.assert_allclose(truth.poses, poses, atol=1e-6)
    assert truth.stamps_ns.tolist() == [f.stamp_ns for f in frames] == [(first + i) * 1_000_000_000 for i in range(2)]
    np.testing.assert_allclose(frames[1].depth_m, depths[1], atol=2e-4)
    assert warp_error_m(*frames, *truth.poses) < 0.012  # half a pixel on the slanted plane
    assert warp_error_m(*frames, *reflect(truth.poses)) > 0.1


def test_published_icl_poses_are_reflected(shared_data: Path, warp_error_m: Callable[..., float]) -> None:
    dataset = IclNuim(path=str(shared_data / "icl_nuim_of_kt3"))
    truth, a, b = dataset.truth(), dataset(9), dataset(49)
    assert truth is not None and a is not None and b is not None
    assert len(dataset) == 59 and np.isin([dataset(0).stamp_ns, b.stamp_ns], truth.stamps_ns).all()
    T_a, T_b = (truth.poses[int(np.searchsorted(truth.stamps_ns, f.stamp_ns))] for f in (a, b))
    assert warp_error_m(a, b, T_a, T_b) < 0.018
    assert warp_error_m(a, b, *reflect(np.array([T_a, T_b]))) > 0.028


@pytest.mark.parametrize(("name", "frames", "limit_m"), [("tum_fr3_structure_notexture_far", 250, 0.012), ("icl_office_rendered", 500, 0.003)])
def test_published_depth_agrees_under_the_truth(
    shared_data: Path, warp_error_m: Callable[..., float], name: str, frames: int, limit_m: float
) -> None:
    dataset = Tum(path=str(shared_data / name))
    truth, a, b = dataset.truth(), dataset(100), dataset(120)
    assert len(dataset) == frames
    assert truth is not None and a is not None and b is not None
    T_a, T_b = (truth.poses[int(np.argmin(np.abs(truth.stamps_ns - f.stamp_ns)))] for f in (a, b))
    assert warp_error_m(a, b, T_a, T_b) < limit_m


@pytest.mark.parametrize("late_ms, warned", [(17, True), (5, False)])
def test_images_paired_by_order_whose_names_are_other_times_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, late_ms: int, warned: bool
) -> None:
    """Five frames of 50 Hz with names in milliseconds since 1970."""
    for kind, late in (("rgb", 0), ("depth", late_ms)):
        (tmp_path / kind).mkdir()
        for k in range(5):
            (tmp_path / kind / f"{1_700_000_000_995 + 20 * k + late}.png").touch()
    (tmp_path / "camera.yaml").write_text("width: 64\nheight: 48\nfx: 50\nfy: 50\ncx: 31.5\ncy: 23.5\ndepth_scale: 1000\n")
    assert len(Folder(path=str(tmp_path))) == 5
    line = "by their names the colour and depth of 5 of 5 frames are more than half a frame apart, by 17.0 ms (median); "
    cure = "remove images without a partner, and give the two of a pair the same name"
    assert caplog.messages == ([f"{tmp_path}: {line}{cure}"] if warned else [])
