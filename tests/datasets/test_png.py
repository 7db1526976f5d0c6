"""PNG files give the pixels of OpenCV; damaged ones are refused."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from trihedron.datasets.readers.images import UnreadableImage, decode_image
from trihedron.pipeline.core import png_codec

FILTERS = {"none": 0, "left": 1, "above": 2, "mean": 3, "Paeth": 4}


@pytest.fixture(params=[True, False], ids=["imagecodecs", "opencv"], autouse=True)
def library(request, monkeypatch):
    monkeypatch.setattr(png_codec, "HAS_IMAGECODECS", request.param)


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
    found = decode_image(data)
    assert found.dtype == expected.dtype and len(np.unique(found)) > 20
    np.testing.assert_array_equal(found[..., ::-1] if color else found, expected)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_what_opencv_writes_is_read_alike(channels, kind):
    image = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (48, 64, channels)).astype(kind)
    data = cv2.imencode(".png", image)[1].tobytes()
    np.testing.assert_array_equal(decode_image(data), image[..., 0] if channels == 1 else image[..., [2, 1, 0, 3][:channels]])


def test_opacity_of_grey_images():
    """Grey with opacity is RGBA; a grey value that counts as transparent stays a value."""
    values = np.arange(18, dtype=np.uint8)
    both = decode_image(png(b"".join(b"\0" + values[9 * r : 9 * r + 8].tobytes() for r in range(2)), 4, 2, color=4))
    assert both.shape == (2, 4, 4) and both[0, 1].tolist() == [2, 2, 2, 3]
    plain = png(b"\0\1\2\0\3\4", 2, 2)
    marked = plain[:33] + chunk(b"tRNS", b"\0\1") + plain[33:]
    assert decode_image(marked).tolist() == decode_image(plain).tolist() == [[1, 2], [3, 4]]


GOOD = zlib.compress(bytes(9) + np.random.default_rng(0).bytes(4 * 9))


@pytest.mark.parametrize("color", [0, 2], ids=["grey", "colour"])
@pytest.mark.parametrize("damage", ["cut short", "a line short", "unknown filter", "not packed", "a bit fell over"])
def test_damage_is_reported(color, damage):
    line = 1 + 8 * (3 if color else 1)
    whole = png(bytes(5 * line), 8, 5, color=color)
    data = {
        "cut short": png(b"", 8, 5, color=color, packed=GOOD[:20]),
        "a line short": png(bytes(4 * line), 8, 5, color=color),
        "unknown filter": png(b"\x07" * 5 * line, 8, 5, color=color),
        "not packed": png(b"", 8, 5, color=color, packed=b"no zlib stream at all"),
        "a bit fell over": whole[:45] + b"\xff" + whole[46:],
    }[damage]
    with pytest.raises(UnreadableImage, match=r"^is damaged \(.+\)$"):
        decode_image(data)


def test_more_bytes_than_claimed_are_not_unpacked():
    """A stream that would unpack to a gigabyte behind a header of 40 pixels."""
    bomb = zlib.compress(bytes(50_000_000), 9)
    np.testing.assert_array_equal(decode_image(png(b"", 8, 5, packed=bomb)), np.zeros((5, 8), np.uint8))
