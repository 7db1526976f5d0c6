"""Safe unpacking of a sequence's archive: no member leaves the folder, no links or devices, bounded in size and number."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import IO, Any

from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.core.files import SHOWN

MOST_MEMBERS = 1_000_000
CHUNK = 1 << 20
COMPRESSIONS: dict[bytes, Callable[..., Any]] = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ": lzma.open}
DAMAGE = (tarfile.TarError, zipfile.BadZipFile, gzip.BadGzipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError, UnicodeError)


class DamagedArchive(DataError):
    """An archive that cannot be read to its end."""


@dataclass(frozen=True)
class Layout:
    """Place of a sequence in its archive: the folder that holds `marker` and, of several, is called `folder`; `nested` is an archive in the
    archive, `also` files from elsewhere in it."""

    marker: str
    folder: str = ""
    nested: str = ""
    also: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Member:
    """A regular file in an archive: its path there, and its bytes as a stream."""

    path: PurePosixPath
    stream: IO[bytes]


def unpack(archive: Path, target: Path, layout: Layout, limit: int) -> None:
    """Unpack a sequence into the folder `target`, at most `limit` bytes. Raises DamagedArchive for what cannot be read, DataError for an archive
    without the sequence, with unsafe members, or too large."""
    try:
        with TemporaryDirectory(dir=target.parent, prefix=".nested-") as temporary:
            inner = _extract_nested(archive, Path(temporary), layout.nested, limit) if layout.nested else None
            source = inner or archive
            root = _find_root(source, layout, bool(inner))
            _extract(source, target, root, set(layout.also), limit)
    except DAMAGE as error:
        cause = f"is damaged ({type(error).__name__}: {printable(str(error), 2 * SHOWN)})"
        raise DamagedArchive(str(archive), cause, "the same command again fetches it anew") from error
    except RuntimeError as error:  # zipfile: an encrypted member
        raise DataError(str(archive), f"cannot be unpacked ({printable(str(error), 2 * SHOWN)})", "unpack it by hand") from error


def _extract_nested(archive: Path, folder: Path, name: str, limit: int) -> Path | None:
    """Write the archive `name` of an archive into a folder; None when there is none (somebody unpacked it)."""
    for member in _members(archive):
        if _ends_with(member.path, name):
            file = folder / member.path.name
            _write(member, file, limit, archive)
            return file
    return None


def _find_root(archive: Path, layout: Layout, nested: bool) -> PurePosixPath:
    """Return the sequence's folder in the archive."""
    roots = sorted({member.path.parent for member in _members(archive) if member.path.name == layout.marker})
    if layout.folder and not nested:
        roots = [root for root in roots if _ends_with(root, layout.folder)]
    if len(roots) == 1:
        return roots[0]
    what = f"no folder {layout.folder} with" if layout.folder and not nested else "no"
    cause = f"holds {what} {layout.marker}" if not roots else f"holds several sequences: {', '.join(str(root) for root in roots[:4])}"
    raise DataError(str(archive), printable(cause, 3 * SHOWN), "is it the archive of this sequence? unpack it by hand if its layout is new")


def _extract(archive: Path, target: Path, root: PurePosixPath, also: set[str], limit: int) -> None:
    written: set[str] = set()
    left = limit
    for member in _members(archive):
        inside = member.path.is_relative_to(root)
        name = str(member.path.relative_to(root)) if inside else member.path.name
        if not inside and name not in also:
            continue
        if name.casefold() in written:
            raise DataError(str(archive), f"holds '{printable(name, SHOWN)}' twice", "unpack it by hand")
        written.add(name.casefold())
        left -= _write(member, target / name, left, archive)


def _write(member: _Member, file: Path, limit: int, archive: Path) -> int:
    """Copy a member, and return its size. Raises DataError beyond `limit` bytes: what the archive states of its sizes is not trusted."""
    file.parent.mkdir(parents=True, exist_ok=True)
    size = 0
    with open(file, "xb") as out:
        while chunk := member.stream.read(CHUNK):
            size += len(chunk)
            if size > limit:
                raise DataError(str(archive), "unpacks to more than is allowed", "give --max-gb N if that is right")
            out.write(chunk)
    return size


def _ends_with(path: PurePosixPath, name: str) -> bool:
    tail = PurePosixPath(name).parts
    return path.parts[-len(tail) :] == tail


def _members(archive: Path) -> Iterator[_Member]:
    """Yield the regular files of a tar or zip archive in its order. Raises DataError for a member that is none, or whose path leaves the folder."""
    if tarfile.is_tarfile(archive):  # first: a tar file may end with a zip archive
        yield from _tar_members(archive)
    elif zipfile.is_zipfile(archive):
        yield from _zip_members(archive)
    else:
        raise DamagedArchive(str(archive), "is neither a tar nor a zip archive", "check its address; a web page may have come instead")


def _zip_members(archive: Path) -> Iterator[_Member]:
    with zipfile.ZipFile(archive) as opened:
        for number, info in enumerate(opened.infolist()):
            kind = info.external_attr >> 28 & 0xF  # of Unix: 0 unknown, 4 folder, 8 file
            path = _checked_path(archive, info.filename, number, kind in (0, 4, 8))
            if not info.is_dir():
                with opened.open(info) as stream:
                    yield _Member(path, stream)


def _tar_members(archive: Path) -> Iterator[_Member]:
    with _open_decompressed(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as opened:
        for number, info in enumerate(opened):
            path = _checked_path(archive, info.name, number, info.isfile() or info.isdir())
            content = opened.extractfile(info) if info.isfile() else None
            if content is not None:
                yield _Member(path, content)
        while stream.read(CHUNK):  # tarfile takes damage for the end; at its own end the compression's checksum is compared
            pass


def _open_decompressed(archive: Path) -> IO[bytes]:
    with open(archive, "rb") as file:
        begin = file.read(6)
    for magic, opener in COMPRESSIONS.items():
        if begin.startswith(magic):
            opened: IO[bytes] = opener(archive, "rb")
            return opened
    return open(archive, "rb")


def _checked_path(archive: Path, name: str, number: int, plain: bool) -> PurePosixPath:
    path = PurePosixPath(name)
    shown = printable(name, SHOWN)
    if number >= MOST_MEMBERS:
        raise DataError(str(archive), f"holds more than {MOST_MEMBERS} files", "unpack it by hand")
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name or re.match("[A-Za-z]:", name):
        raise DataError(str(archive), f"holds '{shown}', which would be written outside its folder", "do not use this archive")
    if not plain:
        raise DataError(str(archive), f"holds '{shown}', which is a link or a device", "do not use this archive")
    return path
