"""Files that come from anyone, read within bounds: regular files of limited size, YAML of limited depth, one line for whatever goes wrong.

Files of results are written whole or not at all, and never through what lies in their place: a folder may be a stranger's, with links in it."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO

import yaml

from trihedron.pipeline.core.errors import DataError, TrihedronError, printable

MAX_NETWORK_BYTES = 2**31  # of an ONNX file, as its format has it
MAX_YAML_BYTES = 1_000_000
MAX_YAML_DEPTH = 20  # of nested lists and mappings
BASE_60, LONGEST_TIME = re.compile(r"[-+\d_.:]*:[-+\d_.:]*"), 100  # to read 1:1:1:… as YAML 1.1 has it takes time with the square of its length
SURROGATE, SLOWLY_READ = re.compile(r"\\uDC[89A-F]", re.IGNORECASE), 100_000  # a byte of a path that is not UTF-8, as PyYAML writes it
PART = 1 << 20  # bytes of a file that are read at once where its size is not known
SHOWN = 60  # characters of a stranger's text in a message
STREAMS = (Path("/dev"), Path("/dev/fd"), Path("/proc/self/fd"))  # folders of devices and open files, which nothing may replace


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading. Raises OSError, for a device, FIFO or socket too, which may never end."""
    return open(_open_descriptor(path)[0], "rb")


def _open_descriptor(path: Path) -> tuple[int, int]:
    """Open a regular file for reading: its descriptor, and how many bytes it has. Raises OSError as `open_file` does."""
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))  # a FIFO blocks without
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL)) from error
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode):
        os.close(descriptor)
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR)) if stat.S_ISDIR(found.st_mode) else OSError(errno.EINVAL, "it is not a regular file")
    return descriptor, found.st_size


def read_file(path: Path, limit: int) -> bytes:
    """Return the bytes of a regular file. Raises OSError for another kind of file, and for more than `limit` bytes.

    Four calls of the system, since after each a thread may wait for the interpreter: a file object makes twice as many."""
    descriptor, size = _open_descriptor(path)
    try:
        data = os.read(descriptor, size + 1) if size <= limit else None  # not `limit`: so much memory is allocated before the first byte is read
        while data is not None and size != len(data) <= limit and (more := os.read(descriptor, PART)):  # it grows, or is of /proc
            data += more
    finally:
        os.close(descriptor)
    if data is None or len(data) > limit:
        raise OSError(errno.EFBIG, f"it has more than {limit} bytes")
    return data


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Lend the path of a file that does not exist yet, for the block to write; it takes the place of `path` after the block, and vanishes if that
    raises. It has the name of `path`, in a folder beside it that belongs to this process. Raises OSError, which names `path`."""
    try:
        if _is_stream(path):
            raise OSError(errno.EINVAL, "it is not a regular file")
        with tempfile.TemporaryDirectory(prefix=".trihedron-", dir=path.parent) as folder:
            yield (new := Path(folder) / path.name)
            os.replace(new, path)
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file, whole or not at all, or to /dev/stdout and the like; text as UTF-8, with ? for what is none. Raises OSError."""
    data = content.encode(errors="replace") if isinstance(content, str) else content
    if _is_stream(path):
        path.write_bytes(data)
    else:
        with new_file(path) as new:
            new.write_bytes(data)


def _is_stream(path: Path) -> bool:
    return path.absolute().parent in STREAMS


def make_folder(path: Path) -> None:
    """Make a folder in one that exists, unless it is there. Raises OSError, for a link in its place too."""
    path.mkdir(exist_ok=True)
    if path.is_symlink():
        raise OSError(errno.ENOTDIR, "it is a link", str(path))


def open_anew(path: Path) -> IO[str]:
    """Open a text file that grows while it is read, in the place of whatever lies there. Raises OSError."""
    path.unlink(missing_ok=True)
    return open(path, "x", encoding="utf-8")


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file of any size, in hexadecimal digits. Raises OSError."""
    with open(path, "rb") as file:
        found = hashlib.sha256()
        while chunk := file.read(1 << 20):
            found.update(chunk)
    return found.hexdigest()


def sha256_of(path: str) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits; nothing for one that cannot be read."""
    with suppress(OSError, RuntimeError):
        return hashlib.sha256(read_file(Path(path).expanduser(), MAX_NETWORK_BYTES)).hexdigest()
    return ""


def read_text(path: Path, limit: int) -> str:
    """Return the UTF-8 text of a regular file, without a byte order mark. Raises DataError."""
    try:
        return read_file(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(str(path), "is not a text file", "give a text file with one entry a line") from error
    except OSError as error:
        raise DataError(str(path), f"cannot be read ({error.strerror})", "check the path and its permissions") from error


class YamlError(ValueError):
    """A text is no YAML that is read here; `line` is where, from 1, or 0."""

    def __init__(self, cause: str, line: int = 0) -> None:
        self.line = line
        super().__init__(cause)


def parse_yaml(text: str, max_depth: int = MAX_YAML_DEPTH) -> Any:
    """Return plain values of YAML without aliases. Raises YamlError, one line."""
    depth = 0
    loader = yaml.SafeLoader if len(text) <= SLOWLY_READ and SURROGATE.search(text) else yaml.CSafeLoader  # libyaml refuses such names of files
    try:
        for event in yaml.parse(text, loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > max_depth or isinstance(event, yaml.AliasEvent):
                raise YamlError("with aliases or deep nesting", event.start_mark.line + 1)
            if isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_TIME and BASE_60.fullmatch(event.value):
                raise YamlError(f"with a number a:b:c of more than {LONGEST_TIME} characters", event.start_mark.line + 1)
        return loader(text).get_single_data()
    except YamlError:
        raise
    except Exception as error:  # PyYAML raises ValueError, TypeError, OverflowError and others for scalars such as 2024-13-45
        mark = getattr(error, "problem_mark", None)
        line = mark.line + 1 if mark else 0
        if "nesting" in str(getattr(error, "problem", "")):  # libyaml refuses by itself since PyYAML 6.0.4
            raise YamlError("with aliases or deep nesting", line) from None
        raise YamlError(f"that is not YAML ({type(error).__name__})", line) from error


@contextmanager
def one_line_errors(place: str, cure: str = "check the file, or record it again") -> Iterator[None]:
    """Turn any exception of a reader into a DataError that names the place: the boundary between a file and the program."""
    try:
        yield
    except (TrihedronError, GeneratorExit):
        raise
    except Exception as error:
        cause = printable(f"{type(error).__name__}: {error}", 4 * SHOWN)
        raise DataError(place, f"cannot be read ({cause})", cure) from error
