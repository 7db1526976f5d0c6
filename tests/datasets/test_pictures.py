"""What a picture claims is looked at before anything decodes it."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from trihedron.datasets.readers import images
from trihedron.datasets.readers.images import decode_image
from trihedron.datasets.readers.picture_headers import UnreadableImage, picture_header

COLOR = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).integers(0, 65535, (12, 16), dtype=np.uint16)
WIDE = 60_000


def encoded(extension: str, pixels: np.ndarray) -> bytes:
    return cv2.imencode(extension, pixels)[1].tobytes()


@pytest.mark.parametrize("extension", [".png", ".bmp", ".ppm", ".tif"])
def test_colour_in_every_format_is_the_same(extension: str) -> None:
    data = encoded(extension, COLOR)
    header = picture_header(data)
    assert (header.width, header.height, header.bits, header.channels) == (16, 12, 8, 3)
    np.testing.assert_array_equal(decode_image(data), COLOR[..., ::-1])
    for size in (20, len(data) // 2, len(data) - 1):
        with pytest.raises(UnreadableImage):
            decode_image(data[:size])


def test_a_jpeg_is_decoded_as_opencv_does_it_whichever_way_the_camera_was_held() -> None:
    turned = b"\xff\xe1\x00\x22Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    plain = encoded(".jpg", COLOR)
    for data in (plain, plain[:2] + turned + plain[2:]):
        expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(decode_image(data), expected[..., ::-1])


@pytest.mark.parametrize("extension", [".png", ".pgm", ".tif"])
def test_depth_in_every_format_is_the_same(extension: str) -> None:
    data = encoded(extension, DEPTH)
    header = picture_header(data)
    assert (header.width, header.height, header.bits, header.channels) == (16, 12, 16, 1)
    np.testing.assert_array_equal(decode_image(data), DEPTH)


def test_headers_as_they_are_written_elsewhere() -> None:
    commented = b"P5 # by hand\n# a camera\n16\t12\n#\n65535\n" + DEPTH.astype(">u2").tobytes()
    np.testing.assert_array_equal(decode_image(commented), DEPTH)
    old = b"BM" + struct.pack("<IHHI", 26 + 36, 0, 0, 26) + struct.pack("<IHHHH", 12, 3, 3, 1, 24) + bytes(range(36))
    assert (picture_header(old).width, picture_header(old).height) == (3, 3) == decode_image(old).shape[:2]
    motorola = struct.pack(">2sHIH", b"MM", 42, 8, 3) + b"".join(struct.pack(">HHIHH", tag, 3, 1, n, 0) for tag, n in [(256, 7), (257, 5), (258, 16)])
    assert (picture_header(motorola).width, picture_header(motorola).height, picture_header(motorola).bits) == (7, 5, 16)


def png() -> bytes:
    data = bytearray(encoded(".png", DEPTH))
    data[16:24] = struct.pack(">II", WIDE, WIDE)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


def jpeg() -> bytes:
    data = bytearray(encoded(".jpg", COLOR))
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", WIDE, WIDE)
    return bytes(data)


def bmp() -> bytes:
    return b"BM" + struct.pack("<IHHIIiiHH", 30, 0, 0, 54, 40, WIDE, -WIDE, 1, 24) + bytes(30)


def pgm() -> bytes:
    return f"P5\n{WIDE} {WIDE}\n65535\n".encode() + bytes(30)


def tiff(*tags: tuple[int, int]) -> bytes:
    rows = sorted({256: 16, 257: 12, 258: 16, 259: 1, 262: 1, 273: 8, 277: 1, 278: 12, 279: 384, **dict(tags)}.items())
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in rows)
    return struct.pack("<2sHI", b"II", 42, 8 + 384) + bytes(384) + struct.pack("<H", len(rows)) + entries + bytes(4)


def wide_tiff() -> bytes:
    return tiff((256, WIDE), (257, WIDE), (278, WIDE))


def wide_tile() -> bytes:
    return tiff((322, 1 << 14), (323, 1 << 14), (324, 8), (325, 384))


@pytest.mark.parametrize("bomb", [png, jpeg, bmp, pgm, wide_tiff, wide_tile])
def test_no_decoder_sees_what_is_larger_than_its_bytes(bomb: Callable[[], bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(UnreadableImage, match=r"^claims \d+×\d+ pixels in \d+ bytes$"):
        decode_image(bomb())


def test_an_ordinary_tiff_made_by_hand_is_read() -> None:
    assert decode_image(tiff()).shape == (12, 16)


@pytest.mark.parametrize(
    "data", [b"", b"BM", b"P5", b"II*\0", b"II*\0\xff\xff\xff\xff", b"\x89PNG", b"\xff\xd8\xff\xc0", b"#?RADIANCE\n", b"P9 1 1\n"]
)
def test_other_files_are_refused(data: bytes) -> None:
    with pytest.raises(UnreadableImage, match="is damaged or of an unknown format"):
        decode_image(data)


def test_a_small_file_of_many_pixels_is_refused_in_little_memory() -> None:
    """A PNG may well pack a thousand pixels into a byte: 20 000 × 20 000 of them, whole and true, in 50 kB."""
    code = """
import resource, struct, sys, zlib
from trihedron.datasets.readers.images import decode_image
def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
pack = zlib.compressobj(9)
rows = b"".join(pack.compress(bytes(2501)) for _ in range(20_000)) + pack.flush()
data = b"\\x89PNG\\r\\n\\x1a\\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 20_000, 20_000, 1, 0, 0, 0, 0)) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    decode_image(data)
except Exception as error:
    print(error, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.startswith("claims 20000×20000 pixels in ") and done.stdout.endswith(" bytes True\n"), done.stdout + done.stderr


def black(width: int, height: int, size: int) -> bytes:
    """A PNG of one bit a pixel, all black, of so many bytes: what it lacks is a comment."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    before = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    after = chunk(b"IDAT", zlib.compress(bytes((width // 8 + 1) * height), 9)) + chunk(b"IEND", b"")
    comment = b"Comment\0".ljust(size - len(before) - len(after) - 12, b" ")
    return before + chunk(b"tEXt", comment) + after


def test_a_byte_holds_2048_pixels_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many in every byte of the file are read; one row more is refused before anything decodes it, and so is what no camera has."""
    within = black(2048, 400, 400)
    assert len(within) == 400 and decode_image(within).shape == (400, 2048)
    monkeypatch.setattr(images, "decode_png", lambda *_: pytest.fail("decoded"))
    for width, height, size in ((2048, 401, 400), (8192, 8193, 100_000)):
        with pytest.raises(UnreadableImage, match=f"^claims {width}×{height} pixels in {size} bytes$"):
            decode_image(black(width, height, size))
