"""Files made to break their reader: each is refused with one line, in bounded memory; pytest-timeout stops what never ends."""

from __future__ import annotations

import os
import re
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from trihedron.datasets.readers.association import read_file_list
from trihedron.datasets.readers.cameras import read_camera_file
from trihedron.datasets.readers.folder import Folder
from trihedron.datasets.readers.icl_nuim import IclNuim
from trihedron.datasets.readers.images import decode_image, read_color, read_depth
from trihedron.datasets.readers.mcap import McapDataset
from trihedron.datasets.readers.picture_headers import PNM_HEAD, PictureHeader, UnreadableImage, picture_header, png_pixels
from trihedron.datasets.readers.replica import read_parameters
from trihedron.datasets.readers.sequence import ImageSequence, SequenceReader
from trihedron.datasets.readers.seven_scenes import SevenScenes
from trihedron.datasets.readers.tum import Tum
from trihedron.pipeline.core.errors import DataError, RecordingError
from trihedron.pipeline.record.trajectories import read_trajectory

GOOD = "width: 32\nheight: 24\nfx: 30\nfy: 30\ncx: 15.5\ncy: 11.5\ndepth_scale: 1000\n"
TEXT_READERS: list[Callable[[Path], object]] = [read_file_list, read_trajectory, read_camera_file, read_parameters]


def fifo(path: Path) -> None:
    os.mkfifo(path)


def zeros(path: Path) -> None:
    path.symlink_to("/dev/zero")


def refused(act: Callable[[], object]) -> str:
    """The one line of a DataError that comes in less than 200 MB: a list may have 64 MB, which are read, decoded and split into lines."""
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as caught:
            act()
        assert tracemalloc.get_traced_memory()[1] < 200e6
    finally:
        tracemalloc.stop()
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600
    return str(caught.value)


@pytest.mark.parametrize("make", [fifo, zeros])
@pytest.mark.parametrize("read", TEXT_READERS)
def test_a_text_that_is_no_regular_file_is_refused(tmp_path: Path, make: Callable[[Path], None], read: Callable[[Path], object]) -> None:
    make(tmp_path / "file.txt")
    expected = f"{tmp_path}/file.txt: cannot be read (it is not a regular file); check the path and its permissions"
    assert refused(lambda: read(tmp_path / "file.txt")) == expected


@pytest.mark.parametrize("make", [fifo, zeros])
def test_an_image_that_is_no_regular_file_is_refused(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "1.png")
    for read in (read_color, lambda path: read_depth(path, 1000.0)):
        with pytest.raises(UnreadableImage, match=r"^cannot be opened \(it is not a regular file\)$"):
            read(tmp_path / "1.png")


@pytest.mark.parametrize("make", [fifo, zeros])
@pytest.mark.parametrize("name", ["a.mcap", "a.bag"])
def test_a_recording_that_is_no_regular_file_is_refused(tmp_path: Path, make: Callable[[Path], None], name: str) -> None:
    make(tmp_path / name)
    with pytest.raises(RecordingError, match="it is not a regular file"):
        len(McapDataset(str(tmp_path / name)))


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 40)  # a hole: takes no space
    with pytest.raises(UnreadableImage, match=r"^cannot be opened \(it has more than 67108864 bytes\)$"):
        read_color(tmp_path / "large")
    for read, limit in zip(TEXT_READERS, (1 << 26, 1 << 26, 1_000_000, 1_000_000)):
        assert f"large: cannot be read (it has more than {limit} bytes)" in refused(partial(read, tmp_path / "large"))


@pytest.mark.parametrize(
    "head", [b"P5", b"P6 #", b"P5" + b" " * 57 + b"x", b"P5" + b"\n#" * 2000 + b"x", b"P5 " + b"9" * 4000, b"P5 4 4 \xff ", b"P9 4 4 255 "]
)
@pytest.mark.timeout(60)  # a pattern that backtracks over comments and blanks does not end
def test_a_damaged_pnm_header_is_refused(head: bytes) -> None:
    with pytest.raises(UnreadableImage, match="is damaged or of an unknown format"):
        decode_image(head)


def test_a_pnm_header_is_read_up_to_its_limit() -> None:
    """Comments before the size are skipped; a size beyond PNM_HEAD bytes is not searched for."""
    size = b"\n4 3 255\n"
    comments = b"P5\n#" + b"x" * (PNM_HEAD - len(b"P5\n#") - len(size))
    assert picture_header(comments + size + bytes(12)) == PictureHeader(4, 3, 8, 1)
    with pytest.raises(UnreadableImage, match="is damaged or of an unknown format"):
        picture_header(comments + b"x" * len(size) + size + bytes(12))


@pytest.mark.parametrize("head", [b"P5\n6#8\n4 4\n255\n", b"P4\n6#20000 20000\n4 4\n", b"P5\n#8\r9 4 255\n4 4 255\n"])
def test_a_pnm_header_that_decoders_read_differently_is_refused(head: bytes) -> None:
    """OpenCV takes the `#` behind a digit for its end, and goes on with what we would skip as a comment."""
    with pytest.raises(UnreadableImage, match=r"^is damaged or of an unknown format$"):
        decode_image(head + bytes(4096))


@pytest.mark.parametrize("head", [b"P5 6 4 255\n", b"P5\n#a\n# b\n6 #c\n\n#d\n4\n255 ", b"P5\n6\t\r\n4\n255\n"])
def test_a_pnm_header_is_that_of_the_image(head: bytes) -> None:
    assert picture_header(head + bytes(24)) == PictureHeader(6, 4, 8, 1)
    assert decode_image(head + bytes(24)).shape == (4, 6)


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def test_texts_of_a_png_are_not_unpacked(capfd: pytest.CaptureFixture[str]) -> None:
    """A hundred of 8 MB each took half a minute. libpng warns of each that it sees."""
    image = np.arange(64, dtype=np.uint8).reshape(8, 8)
    png = cv2.imencode(".png", image)[1].tobytes()
    packed = zlib.compress(bytes(8 << 20), 9)
    texts = chunk(b"zTXt", b"a\0\0" + packed) + chunk(b"iTXt", b"a\0\1\0\0\0" + packed) + chunk(b"iCCP", b"a\0\0" + packed)
    start = 8 + 12 + 13  # signature and header
    assert png_pixels(png[:start] + 100 * texts + png[start:]) == png
    assert np.array_equal(decode_image(png[:start] + texts + png[start:]), image)
    assert capfd.readouterr().err == ""


def test_a_long_line_of_a_list_is_not_quoted(tmp_path: Path) -> None:
    path = tmp_path / "rgb.txt"
    for line in ("1.0 " + "x" * 10_000_000, "9" * 10_000_000 + " a.png", "1.0 " + "y " * 5_000_000):
        path.write_text(f"0.5 a.png\n{line}\n")
        assert refused(lambda: read_file_list(path)) == f"{path}:2: is longer than 4096 characters; give one entry a line"
    path.write_text("\n" * 1_000_001)
    assert refused(lambda: read_file_list(path)) == f"{path}: has more than 1000000 lines; give a shorter list"
    path.write_text(f"{'n' * 4000} a.png\n")
    assert f"{path}:1: the time stamp '{'n' * 59}…' is not a number of seconds" in refused(lambda: read_file_list(path))
    path.write_text("1.0 ../" + "\x1b" * 4000 + "\n")
    assert f"{path}:1: the file '../{'?' * 56}…' is outside the folder of the list" in refused(lambda: read_file_list(path))


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("a: &a [1, 1]\n" + "".join(f"b{k}: &b{k} [*a, *a]\n" for k in range(30)), ":2: holds aliases or deep nesting"),
        ("fx: " + "[" * 200_000, ":1: holds aliases or deep nesting"),
        ("fx: " + "[" * 21 + "]" * 21, ":1: holds aliases or deep nesting"),
        ("width: " + ":".join(["1"] * 400_000), ":1: holds a number a:b:c of more than 100 characters"),  # took 35 s
        (GOOD + "fps: 2024-13-45\n", ": is not YAML"),
        (GOOD + "fps: !!int x\n", ": is not YAML"),
        (GOOD + f"fps: {'9' * 5000}\n", ": is not YAML"),
        (GOOD + "fps: 2024-12-24\n", ": fps is '2024-12-24'"),
        (GOOD + f"fps: {'9' * 4000}\n", ": fps is '"),
        (GOOD + "fps: 1e-320\n", ": fps is not within 1e-06 … 1e+06"),
        (GOOD + "fps: !!python/object/apply:os.system [id]\n", ":8: is not YAML"),
        (GOOD + f"{'k' * 900_000}: 1\n", ":8: is not YAML"),
        (GOOD + f"? {'k' * 900_000}\n: 1\n", f": unknown key '{'k' * 59}…'"),
        (GOOD.replace("width: 32", "width: 1e300"), ": describes no camera"),
        (GOOD.replace("depth_scale: 1000", "depth_scale: 1e-320"), ": depth_scale is not within 1e-06 … 1e+09"),
    ],
    ids=["aliases", "nesting", "nesting of 21", "base 60", "no date", "no int", "digits", "date", "digits that are read", "fps", "object", "long key",
         "longer key", "width", "scale"],
)  # fmt: skip
def test_a_hostile_camera_file_is_one_line(tmp_path: Path, text: str, cause: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    assert refused(lambda: read_camera_file(path)).startswith(f"{path}{cause}")


def write_pair(folder: Path, color: str, depth: str) -> None:
    for name, image in ((color, np.full((24, 32, 3), 7, np.uint8)), (depth, np.full((24, 32), 2000, np.uint16))):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), image)


@pytest.mark.parametrize("name", ["²1", "9" * 19, "9" * 200, "٣", "9" * 13 + ".5"])
def test_file_names_that_look_like_numbers(tmp_path: Path, name: str) -> None:
    """Names of digits that are none, or too many: read by their position, or refused with one line."""
    write_pair(tmp_path, f"rgb/{name}.png", f"depth/{name}.png")
    (tmp_path / "camera.yaml").write_text(GOOD)
    try:
        frames = [Folder(path=str(tmp_path))(0), IclNuim(path=str(tmp_path))(0) if name == "٣" else None]
        assert frames[0] is not None and frames[0].stamp_ns >= 0
    except DataError as error:
        assert name.endswith(".5") and "is too large for seconds" in str(error)
    if name != "٣":
        assert "holds no image pairs of either ICL-NUIM layout" in refused(lambda: len(IclNuim(path=str(tmp_path))))
    for suffix in ("depth", "png"):
        (tmp_path / f"scene_00_{name}.{suffix}").touch()
    assert name == "٣" or "has no image number in its name" in refused(lambda: len(IclNuim(path=str(tmp_path))))


def test_frame_numbers_beyond_64_bits_of_time(tmp_path: Path) -> None:
    write_pair(tmp_path, "frame-999999999.color.png", "frame-999999999.depth.png")
    (tmp_path / "camera.yaml").write_text(GOOD + "fps: 0.001\n")
    expected = "camera.yaml: fps is 0.001, too few for frame numbers up to 999999999; give the frames per second"
    assert refused(lambda: len(SevenScenes(path=str(tmp_path)))) == expected


def test_names_that_no_file_can_have(tmp_path: Path, tum_folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    with (tum_folder / "rgb.txt").open("a") as file:
        file.write(f"11.0 {'x' * 4000}.png\n12.0 a\0b.png\n")
    assert len(Tum(path=str(tum_folder))) == 4
    assert len(caplog.messages) == 1 and len(caplog.messages[0]) < 600


class Broken(SequenceReader):
    """A reader with a defect."""

    def _open(self, folder: Path) -> ImageSequence:
        raise IndexError("list index out of range\nsecond line")


def test_any_exception_of_a_reader_is_one_line(tum_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trihedron.datasets.readers.mcap.open_messages", None)
    assert refused(lambda: len(McapDataset("a.mcap"))).startswith("a.mcap: cannot be read (TypeError: ")
    expected = f"{tum_folder}: cannot be read (IndexError: list index out of range?second line); check the files of the data set"
    assert refused(lambda: len(Broken(path=str(tum_folder)))) == expected
    dataset = Tum(path=str(tum_folder))
    assert len(dataset) == 4
    monkeypatch.setattr(cv2, "cvtColor", None)
    monkeypatch.setattr(ImageSequence, "_check_sizes", None)
    assert re.search(r"10\.000000\.png: cannot be read \(TypeError: ", refused(lambda: dataset(0)))
