"""An MCAP file that loses little: what makes messages is handed over, and a thread of its own closes chunks by size and by time and puts them on the
disk.

A process that is killed, or a plug that is pulled, costs what was handed over since the last chunk, `CHUNK_SECONDS` or two; the rest is whole, and
`trihedron recover` gives it its index. Encoding, compression and the disk wait beside the run, not in it."""

from __future__ import annotations

import fcntl
import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.record.mcap_writer import McapWriter

log = logging.getLogger("trihedron")
Messages = Iterable[tuple[int, int, bytes]]  # channel, log time in ns, content
CHUNK_BYTES = 4 << 20  # an entry of the index, which waits in memory for the end, is worth more messages
CHUNK_SECONDS = 0.4
MESSAGE_OVERHEAD = 64  # bytes of a message beside its data, generously
MOST_WAITING = 64 << 20  # bytes in memory; who writes faster than the disk waits from there on


class ChunkWriter:
    """One file. Once the disk refuses it, that is warned of, what follows is dropped, so that the run can go on, and `close` raises RecordingError.

    A chunk is closed before it would exceed `CHUNK_BYTES` (a larger message has one of its own), and when it is `CHUNK_SECONDS` old."""

    def __init__(self, path: Path) -> None:
        """Raises RecordingError when the file cannot be written or another process is writing it."""
        self.path, self.failure = path, None
        self._file = _locked(path)
        self._whole = 0  # bytes up to the end of the last whole record
        self._chunk_bytes = 0
        self._writer = McapWriter(self._file)
        self._chunk: list[tuple[int, int, bytes]] = []
        self._guarded(lambda: self._writer.start(library="trihedron"))
        self._waiting: deque[tuple[int, Callable[[], Messages]]] = deque()
        self._handed_bytes, self._taken_bytes = 0, 0  # each of one thread alone, so that a message handed over takes no lock
        self._closing = False
        self._mistake: BaseException | None = None  # of what makes messages
        self._enough, self._room, self._writing = threading.Event(), threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._work, name=f"writer of {path.name}", daemon=True)
        self._thread.start()

    failure: OSError | None

    def metadata(self, name: str, content: dict[str, str]) -> None:
        """Add a metadata record."""
        with self._writing:
            self._guarded(lambda: self._writer.metadata(name, content))

    def attach(self, name: str, text: str) -> None:
        """Add a text file."""
        with self._writing:
            self._guarded(lambda: self._writer.attachment(name, "text/plain", text.encode()))

    def channel(self, topic: str, schema: str, encoding: str, definition: bytes, message_encoding: str) -> int:
        """Declare a channel with a schema of its own; returns its number. For what was handed over to call: between chunks no other thread writes."""
        return self._writer.channel(topic, schema, encoding, definition, message_encoding)

    def add(self, size: int, made: Callable[[], Messages]) -> None:
        """Hand over what makes messages, and how many bytes of memory wait for it, about. It is called in the writer's thread, in the order of the
        calls; what it raises is raised by the next call, or by `close`, and ends the file there."""
        if self._mistake is not None:
            raise self._mistake
        self._handed_bytes += size + MESSAGE_OVERHEAD
        self._waiting.append((size + MESSAGE_OVERHEAD, made))
        if self._handed_bytes - self._taken_bytes > CHUNK_BYTES:
            self._enough.set()
            self._room.clear()
            while self._handed_bytes - self._taken_bytes > MOST_WAITING:
                self._room.wait(CHUNK_SECONDS)
                self._room.clear()

    def close(self) -> None:
        """Write what waits, and the index; the file is complete only then. Raises RecordingError when that, or anything before, failed."""
        if not self._file.closed:
            self._closing = True
            self._enough.set()
            self._thread.join()
            self._guarded(self._writer.finish)
            self._file.close()
            if self._mistake is not None:
                raise self._mistake
            if self.failure is not None:
                cure = f"what was written before is kept; index it with: trihedron recover {self.path}"
                raise RecordingError(str(self.path), f"cannot be written: {self.failure.strerror}", cure) from self.failure

    def _work(self) -> None:
        closing = False
        while not closing:
            self._enough.wait(CHUNK_SECONDS)
            self._enough.clear()
            closing = self._closing
            if self._waiting:
                with self._writing:
                    self._guarded(self._write)
            self._forget()

    def _write(self) -> None:
        """What waits now, as chunks."""
        for _ in range(len(self._waiting)):
            for message in self._made():
                size = len(message[2]) + MESSAGE_OVERHEAD
                if self._chunk_bytes + size > CHUNK_BYTES:
                    self._end_chunk()
                self._chunk.append(message)
                self._chunk_bytes += size
        self._end_chunk()
        self._file.sync()

    def _made(self) -> Messages:
        """The messages of what was handed over first."""
        size, make = self._waiting.popleft()
        try:
            made = list(make()) if self._mistake is None else []
        except Exception as error:
            self._mistake, made = error, []
        self._taken_bytes += size
        if not self._room.is_set():  # which asks for no lock
            self._room.set()
        return made

    def _forget(self) -> None:
        """What waits when nothing can be written any more."""
        while self._waiting and (self.failure is not None or self._mistake is not None):
            self._taken_bytes += self._waiting.popleft()[0]
        self._room.set()

    def _end_chunk(self) -> None:
        chunk, self._chunk, self._chunk_bytes = self._chunk, [], 0
        if chunk:
            self._writer.chunk(chunk)
            self._whole = self._file.tell()

    def _guarded(self, action: Any) -> None:
        """Do it; if the disk refuses, keep why, and cut the file after its last whole record."""
        if self.failure is not None:
            return
        try:
            action()
            self._whole = self._file.tell()
        except OSError as error:
            self.failure = error
            self._file.cut(self._whole)
            log.warning("%s: cannot be written: %s; the rest is done without it", self.path, error.strerror)


class _Descriptor:
    """A file without a buffer: what `write` returned from is with the system, so that a killed process cannot lose it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self._position, self.closed = descriptor, 0, False

    def write(self, data: Any) -> None:
        rest = memoryview(data)
        while rest:
            count = os.write(self._descriptor, rest)
            rest, self._position = rest[count:], self._position + count

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Nothing waits here."""

    def sync(self) -> None:
        if os.fstat(self._descriptor).st_size:  # a device has none, and refuses
            os.fdatasync(self._descriptor)

    def cut(self, size: int) -> None:
        if os.fstat(self._descriptor).st_size > size:
            os.ftruncate(self._descriptor, size)

    def close(self) -> None:
        self.closed = True
        os.close(self._descriptor)


def _locked(path: Path) -> Any:
    """The file, emptied, for this process alone."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError as error:
        raise RecordingError(str(path), f"cannot be written: {error.strerror}", "give another out=FOLDER") from error
    if is_being_written(descriptor):
        os.close(descriptor)
        raise RecordingError(str(path), "is being written by another process", "wait until that has ended, or give another out=FOLDER")
    file = _Descriptor(descriptor)
    file.cut(0)
    return file


def is_being_written(descriptor: int, lock: int = fcntl.LOCK_EX) -> bool:
    """Whether another holds the file's lock; takes it if not. False where the file system knows no locks."""
    try:
        fcntl.flock(descriptor, lock | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
