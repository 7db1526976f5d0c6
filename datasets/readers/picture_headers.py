"""Headers of images, read before a decoder allocates what they claim.

PNG, JPEG, BMP, PNM (PBM, PGM, PPM) and TIFF; other formats are refused, so that no decoder sees a file whose size was not looked at."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass

PNG, JPEG, BMP = b"\x89PNG", b"\xff\xd8\xff", b"BM"
PNG_START = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4s", 13, b"IHDR")
TIFFS = {b"II*\0": "<", b"MM\0*": ">"}  # little and big endian
BLANK = rb"\s(?:\s|#[^\r\n]*\n)*"  # of a PNM; decoders disagree on a comment that begins behind a digit, or ends with \r
PNM = re.compile(rb"P([1-6])" + BLANK + rb"(\d{1,9})" + BLANK + rb"(\d{1,9})(?:" + BLANK + rb"(\d{1,9}))?\s")
PNM_HEAD = 4096  # bytes that hold the header of a PNM with its comments
ANCILLARY = 0x20  # bit of the first letter of a PNG chunk's name
FRAME_MARKS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # of a JPEG: segments that hold its size
TIFF_WIDTH, TIFF_HEIGHT, TIFF_BITS, TIFF_SAMPLES, TIFF_TILE_WIDTH, TIFF_TILE_HEIGHT = 256, 257, 258, 277, 322, 323
TIFF_FORMATS = {1: "B", 3: "H", 4: "I"}


class UnreadableImage(Exception):
    """A file that cannot be opened or decoded; the message is the cause."""


@dataclass(frozen=True)
class PictureHeader:
    """Claimed size of an image; `bits` are of one channel. `cells` are the pixels of its largest part: of the image, or of a tile of it."""

    width: int
    height: int
    bits: int
    channels: int
    tile: int = 0

    @property
    def cells(self) -> int:
        """Pixels that a decoder makes room for at once."""
        return max(self.width * self.height, self.tile)


def picture_header(data: bytes) -> PictureHeader:
    """Read the header of an image. Raises UnreadableImage for another format or none."""
    reader = next((reader for magic, reader in READERS.items() if data.startswith(magic)), _pnm)
    try:
        header = reader(data)
    except struct.error:
        header = None
    if header is None or header.width < 1 or header.height < 1:
        raise UnreadableImage("is damaged or of an unknown format")
    return header


def png_pixels(data: bytes) -> bytes | None:
    """Return a PNG without the chunks that say nothing of its pixels, which may unpack to gigabytes of text; None for one whose chunks, the header
    first, do not lie within its bytes: a decoder allocates a chunk before it reads it."""
    if not data.startswith(PNG_START):
        return None
    at, kept = len(PNG_START) - 8, [data[:8]]
    while at + 12 <= len(data):
        length, name = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length  # with name and checksum
        if not name[0] & ANCILLARY or name == b"tRNS":
            kept.append(data[at:end])
        if name == b"IEND":
            return b"".join(kept) if end <= len(data) else None
        at = end
    return None


def _png(data: bytes) -> PictureHeader:
    width, height, bits, color = struct.unpack_from(">IIBB", data, 16)
    return PictureHeader(width, height, bits, {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(color, 3))


def _jpeg(data: bytes) -> PictureHeader | None:
    at = 2
    while at + 10 <= len(data) and data[at] == 0xFF:
        if data[at + 1] in FRAME_MARKS:
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            return PictureHeader(width, height, bits, channels)
        at += 1 if data[at + 1] == 0xFF else 2 + max(2, struct.unpack_from(">H", data, at + 2)[0])
    return None


def _bmp(data: bytes) -> PictureHeader:
    if struct.unpack_from("<I", data, 14)[0] == 12:  # of OS/2
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
    else:
        width, height, _, bits = struct.unpack_from("<iiHH", data, 18)
    return PictureHeader(abs(width), abs(height), 8, max(1, bits // 8))  # rows from the top have a negative height


def _pnm(data: bytes) -> PictureHeader | None:
    """The header is words between blanks and comments: kind, width, height and, but for bitmaps, the largest value."""
    found = PNM.match(data[:PNM_HEAD])
    if found is None or (found[1] not in b"14" and found[4] is None):
        return None
    bits = 1 if found[1] in b"14" else 16 if int(found[4]) > 255 else 8
    return PictureHeader(int(found[2]), int(found[3]), bits, 3 if found[1] in b"36" else 1)


def _tiff(data: bytes) -> PictureHeader | None:
    order = TIFFS[data[:4]]
    at = struct.unpack_from(order + "I", data, 4)[0]
    found = {TIFF_BITS: 1, TIFF_SAMPLES: 1, TIFF_TILE_WIDTH: 0, TIFF_TILE_HEIGHT: 0, TIFF_WIDTH: 0, TIFF_HEIGHT: 0}
    for row in range(struct.unpack_from(order + "H", data, at)[0]):
        place = at + 2 + 12 * row
        tag, form, count = struct.unpack_from(order + "HHI", data, place)
        if tag in found and form in TIFF_FORMATS:
            element = order + TIFF_FORMATS[form]
            far = struct.calcsize(element) * count > 4  # the values stand elsewhere
            found[tag] = struct.unpack_from(element, data, struct.unpack_from(order + "I", data, place + 8)[0] if far else place + 8)[0]
    tile = found[TIFF_TILE_WIDTH] * found[TIFF_TILE_HEIGHT]
    return PictureHeader(found[TIFF_WIDTH], found[TIFF_HEIGHT], found[TIFF_BITS], found[TIFF_SAMPLES], tile)


READERS: dict[bytes, Callable[[bytes], PictureHeader | None]] = {PNG: _png, JPEG: _jpeg, BMP: _bmp, **dict.fromkeys(TIFFS, _tiff)}
