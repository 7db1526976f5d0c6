"""Our PNG decoder gives OpenCV's pixels, and refuses what is damaged."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from trihedron.datasets.readers.images import UnreadableImage, decode_image
from trihedron.datasets.readers.png_decoder import decode_png

FILTERS = {"none": 0, "left": 1, "above": 2, "mean": 3, "Paeth": 4}


def chunk(name, body):
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png(lines, width, height, bits=8, color=0, interlaced=0, packed=None):
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, interlaced)
    body = zlib.compress(lines) if packed is None else packed
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body[:7]) + chunk(b"IDAT", body[7:]) + chunk(b"IEND", b"")


@pytest.mark.parametrize("kind", FILTERS.values(), ids=FILTERS)
@pytest.mark.parametrize("bits, color", [(8, 0), (16, 0), (8, 2), (16, 2)])
def test_every_filter_gives_the_pixels_of_opencv(kind, bits, color):
    """Any bytes are an image under any filter."""
    rng = np.random.default_rng(kind)
    width, height, pixel = 13, 9, bits // 8 * (3 if color else 1)
    lines = b"".join(bytes([kind]) + rng.bytes(width * pixel) for _ in range(height))
    data = png(lines, width, height, bits, color)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    found = decode_png(data)
    assert found.dtype == expected.dtype and len(np.unique(found)) > 20
    np.testing.assert_array_equal(found[..., ::-1] if color else found, expected)
    np.testing.assert_array_equal(decode_image(data), found)


def test_what_opencv_writes_is_read_alike():
    smooth = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 65535, (48, 64)).astype(np.uint16), (0, 0), 3)
    np.testing.assert_array_equal(decode_png(cv2.imencode(".png", smooth)[1].tobytes()), smooth)


@pytest.mark.parametrize("channels", [4, 3], ids=["with transparency", "without"])
def test_what_is_not_read_here_is_left_to_opencv(channels):
    image = np.arange(35 * channels, dtype=np.uint8).reshape(5, 7, channels)
    data = cv2.imencode(".png", image)[1].tobytes()
    assert (decode_png(data) is None) == (image.shape[2] == 4)
    np.testing.assert_array_equal(decode_image(data), image[..., [2, 1, 0, 3][: image.shape[2]]])


GOOD = zlib.compress(bytes(9) + np.random.default_rng(0).bytes(4 * 9))


@pytest.mark.parametrize(
    "data, cause",
    [
        (png(b"", 8, 5, packed=GOOD[:20]), "it holds fewer pixels than it claims"),
        (png(bytes(4 * 9), 8, 5), "it holds fewer pixels than it claims"),
        (png(b"\x07" * 45, 8, 5), "it names an unknown filter"),
        (png(b"", 8, 5, packed=b"no zlib stream at all"), "its bytes do not unpack"),
        (png(bytes(45), 8, 5)[:45] + b"\xff" + png(bytes(45), 8, 5)[46:], "a checksum is wrong"),
    ],
    ids=["cut short", "a line short", "unknown filter", "not packed", "a bit fell over"],
)
def test_damage_is_said(data, cause):
    with pytest.raises(UnreadableImage, match=f"^is damaged: {cause}$"):
        decode_image(data)


def test_more_bytes_than_claimed_are_not_unpacked():
    """A stream that would unpack to a gigabyte behind a header of 40 pixels."""
    bomb = zlib.compress(bytes(50_000_000), 9)
    np.testing.assert_array_equal(decode_png(png(b"", 8, 5, packed=bomb)), np.zeros((5, 8), np.uint8))
