"""Bad input: one line with the file, the cause and the cure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from trihedron.datasets.readers.folder import Folder
from trihedron.datasets.readers.icl_nuim import IclNuim
from trihedron.datasets.readers.tum import Tum
from trihedron.pipeline.core.errors import DataError

Change = Callable[[Path], Any]


def replace(file: str, old: str, new: str) -> Change:
    return lambda folder: (folder / file).write_text((folder / file).read_text().replace(old, new))


def image(file: str, shape: tuple[int, ...], kind: Any) -> Change:
    return lambda folder: cv2.imwrite(str(folder / file), np.ones(shape, dtype=kind))


def remove(*names: str) -> Change:
    def change(folder: Path) -> None:
        for name in names:
            for file in folder.glob(name):
                file.unlink()

    return change


def fault(act: Callable[[], Any]) -> str:
    with pytest.raises(DataError) as caught:
        act()
    assert "\n" not in str(caught.value)
    return str(caught.value)


COLUMNS = "each line holds 'stamp tx ty tz qx qy qz qw'; correct or remove this one"
TUM: list[tuple[Change, str]] = [
    (remove("rgb.txt"), "{}/rgb.txt: is missing; it lists the colour images; without lists use dataset=folder"),
    (remove("depth.txt"), "{}/depth.txt: is missing; it lists the depth images; without lists use dataset=folder"),
    (replace("rgb.txt", "10.200000 ", "9.200000 "),
     "{}/rgb.txt:4: the time stamp 9.200000 does not come after the one before; sort the list and remove duplicates"),
    (replace("depth.txt", "10.105 ", "noon "),
     "{}/depth.txt:3: the time stamp 'noon' is not a number of seconds; each line holds 'stamp file'; correct or remove this one"),
    (replace("depth.txt", "10.105 ", "1403636579763555584 "),
     "{}/depth.txt:3: the time stamp '1403636579763555584' is too large for seconds: is it in nanoseconds?; "
     "each line holds 'stamp file'; correct or remove this one"),
    (replace("rgb.txt", "10.100000 rgb/10.100000.png", "10.100000"),
     "{}/rgb.txt:3: has 1 column instead of 2; each line holds 'stamp file'; correct or remove this one"),
    (lambda f: (f / "rgb.txt").write_text("# nothing\n"), "{}/rgb.txt: lists no images; give a list with a line 'stamp file' for each image"),
    (replace("depth.txt", "\n10.", "\n20."), "{}: no colour and depth image are within 20 ms of each other; check the stamps in rgb.txt and depth.txt"
     " or raise dataset.max_difference_ms"),
    (replace("groundtruth.txt", "1 0 0 0", "nan 0 0 0"), "{}/groundtruth.txt:2: the pose is not finite; " + COLUMNS),
    (replace("groundtruth.txt", "2 0 0 0 0 0 1", "2 0 0 0 0 0 0"), "{}/groundtruth.txt:3: the quaternion is zero; " + COLUMNS),
    (replace("groundtruth.txt", "2 0 0 0 0 0 1", "2 0 0"), "{}/groundtruth.txt:3: has 4 columns instead of 8; " + COLUMNS),
    (replace("groundtruth.txt", "2 0 0 0 0 0 1", "2 0 0 0 0 zero 1"), "{}/groundtruth.txt:3: a column is not a number; " + COLUMNS),
    (replace("groundtruth.txt", "10.2", "10.1"),
     "{}/groundtruth.txt:3: the time stamp 10.100000 does not come after the one before; sort the file and remove duplicates"),
    (remove("groundtruth.txt"), ""),
    (lambda f: (f / "groundtruth.txt").write_text(""),
     "{}/groundtruth.txt: holds no poses; give a file with a line 'stamp tx ty tz qx qy qz qw' for each pose"),
    (lambda f: (f / "groundtruth.txt").write_bytes(b"\xff\xfe\x00\x81"),
     "{}/groundtruth.txt: is not a text file; give a text file with one entry a line"),
    (remove("camera.yaml"), "{}: has no camera.yaml, and its name is not that of a data set whose camera is known;"
     " give dataset.camera=tum_fr1, tum_fr2, tum_fr3, icl_nuim or a camera.yaml"),
    (image("depth/10.000000.png", (24, 32), np.uint8), "{}/depth/10.000000.png: has 8 bits a pixel where depth has 16;"
     " give 16-bit depth images (value = metres × depth_scale); a preview picture does not hold metres"),
    (image("depth/10.000000.png", (24, 32, 3), np.uint16),
     "{}/depth/10.000000.png: has 3 channels where depth has 1; give 16-bit depth images with one channel"),
    (image("depth/10.000000.png", (12, 16), np.uint16),
     "{}/depth/10.000000.png: is 16×12 while its colour image 10.000000.png is 32×24; register depth to colour first"),
    (image("rgb/10.000000.png", (24, 32), np.uint8), "{}/rgb/10.000000.png: has 1 channel where colour has 3; convert it to an RGB image"),
    (image("rgb/10.000000.png", (24, 32), np.uint16),
     "{}/rgb/10.000000.png: has 16 bits a channel where colour has 8; give 8-bit RGB images; are colour and depth swapped?"),
    (replace("camera.yaml", "width: 32", "width: 64"),
     "{}/rgb/10.000000.png: is 32×24 while the camera is 64×24; give the dataset.camera of these images"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), TUM)
def test_a_bad_tum_folder_is_one_line(tum_folder: Path, change: Change, message: str) -> None:
    change(tum_folder)
    dataset = Tum(path=str(tum_folder))
    if not message:
        assert dataset(0) is not None
        return
    assert fault(lambda: (len(dataset), dataset(0))) == message.format(tum_folder)


FOLDER: list[tuple[Change, str]] = [
    (lambda f: (f / "color").rename(f / "left"), "{}: has no subfolder of colour images; call it rgb or color or colour or image"),
    (lambda f: (f / "depth").rename(f / "z"), "{}: has no subfolder of depth images; call it depth"),
    (remove("depth/*"), "{}/depth: holds no images; put the images there as .png (depth must be 16-bit)"),
    (lambda f: [(f / f"depth/{a}.png").rename(f / f"depth/{b}.png") for a, b in ((8, "x"), (9, "y"))] and (f / "depth/10.png").unlink(),
     "{}: 3 colour and 2 depth images have no name in common; give the two images of a pair the same name"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), FOLDER)
def test_a_bad_plain_folder_is_one_line(plain_folder: Path, change: Change, message: str) -> None:
    change(plain_folder)
    assert fault(lambda: len(Folder(path=str(plain_folder)))) == message.format(plain_folder)


@pytest.mark.parametrize("reader", [Tum, IclNuim, Folder])
def test_a_path_that_is_no_folder_is_one_line(tmp_path: Path, reader: type) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    cure = "give the folder that holds the images as dataset.path"
    assert fault(lambda: len(reader())) == "dataset.path: is not set; give dataset.path=FOLDER"
    assert fault(lambda: len(reader(path=str(tmp_path / "no")))) == f"{tmp_path}/no: does not exist; give an existing folder as dataset.path"
    assert fault(lambda: len(reader(path=str(tmp_path / "file")))) == f"{tmp_path}/file: is not a folder; {cure}"
    assert fault(lambda: len(reader(path=str(tmp_path / "empty")))) == f"{tmp_path}/empty: is empty; {cure}"


ICL: list[tuple[Change, str]] = [
    (lambda f: None,
     "{}: holds no image pairs of either ICL-NUIM layout; give the folder that holds rgb/0.png and depth/0.png, or scene_00_0000.png and .depth"),
    (lambda f: (f / "associations.txt").write_text("1 rgb/1.png 1 other/1.png\n"),
     "{}/associations.txt:1: does not name a depth and a colour file; each line holds 'number depth/FILE number rgb/FILE'"),
    (lambda f: (f / "associations.txt").write_text("2 depth/2.png 2 rgb/2.png\n1 depth/1.png 1 rgb/1.png\n"),
     "{}/associations.txt:2: image 1 does not come after the one before; sort the list and remove duplicates"),
    (lambda f: (f / "associations.txt").write_text(""),
     "{}/associations.txt: lists no images; give a list with a line 'number depth/FILE number rgb/FILE' for each pair"),
    (lambda f: (f / "scene_00_0000.depth").write_text("1"),
     "{}: holds .depth files but none of their .png images; unpack the colour images into the same folder"),
    (lambda f: [(f / name).write_text("") for name in ("scene_00_0000.depth", "scene_00_0000.png", "scene_00_0000.txt")],
     "{}/scene_00_0000.txt: has no line 'cam_pos = [x, y, z]'; correct or remove the file"),
    (lambda f: [(f / name).write_text("1 depth/1.png 1 rgb/1.png") for name in ("associations.txt", "a.freiburg", "b.freiburg")],
     "{}: holds several trajectories: a.freiburg, b.freiburg; keep the one of this sequence"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), ICL)
def test_a_bad_icl_folder_is_one_line(tmp_path: Path, change: Change, message: str) -> None:
    (tmp_path / "SOURCE.txt").write_text("about")
    change(tmp_path)
    assert fault(lambda: len(IclNuim(path=str(tmp_path)))) == message.format(tmp_path)


def test_a_depth_text_file_cut_short_is_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "scene_00_0000.depth").write_text("1 2 3")
    cv2.imwrite(str(tmp_path / "scene_00_0000.png"), np.zeros((480, 640, 3), dtype=np.uint8))
    assert IclNuim(path=str(tmp_path))(0) is None
    assert caplog.messages == [f"{tmp_path}/scene_00_0000.depth: holds 3 distances instead of 307200; frame 0 is skipped"]


def test_a_range_beyond_the_end_is_one_line(tum_folder: Path) -> None:
    expected = f"dataset.frames: '4:6' begins beyond the 4 frames of {tum_folder}; give a range within 0:4"
    assert fault(lambda: len(Tum(path=str(tum_folder), frames="4:6"))) == expected


@pytest.mark.parametrize("reader", [Tum, IclNuim, Folder])
@pytest.mark.parametrize("text", ["3:2", "1", "a:b", "-2:"])
def test_a_range_that_is_none_is_refused_at_once(reader: type, text: str) -> None:
    with pytest.raises(ValueError, match=rf"^frames: '{text}' is not a range of frames A:B\[:S\] with A < B, S > 0$"):
        reader(frames=text)


@pytest.mark.parametrize("reader", [Tum, Folder])
def test_the_largest_difference_must_be_positive(reader: type) -> None:
    with pytest.raises(ValueError, match=r"^max_difference_ms: 0\.0 is not positive$"):
        reader(max_difference_ms=0.0)
