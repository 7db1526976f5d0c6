"""An MCAP file that loses little: messages are handed over, and a thread of its own closes chunks by size and by time and puts them on the disk.

A process that is killed, or a plug that is pulled, costs what was handed over since the last chunk, `CHUNK_SECONDS` or two; the rest is whole, and
`trihedron recover` gives it its index. Compression and the disk wait beside the run, not in it."""

from __future__ import annotations

import fcntl
import logging
import os
import threading
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from trihedron.pipeline.errors import RecordingError

log = logging.getLogger("trihedron")
CHUNK_BYTES = 4 << 20  # an entry of the index, which waits in memory for the end, is worth more messages
CHUNK_SECONDS = 0.4
MESSAGE_OVERHEAD = 64  # bytes of a message beside its data, generously
MOST_WAITING = 64 << 20  # bytes; who writes faster than the disk waits from there on


class ChunkWriter:
    """One file. Once the disk refuses it, that is warned of, what follows is dropped, so that the run can go on, and `close` raises RecordingError.

    A chunk is closed before it would exceed `CHUNK_BYTES` (a larger message has one of its own), and when it is `CHUNK_SECONDS` old."""

    def __init__(self, path: Path) -> None:
        """Raises RecordingError when the file cannot be written or another process is writing it."""
        self.path, self.failure = path, None
        self._file = _locked(path)
        self._whole = 0  # bytes up to the end of the last whole record
        self._chunk_bytes = 0
        self._writer: Any = Writer(self._file, chunk_size=2 * CHUNK_BYTES, compression=CompressionType.ZSTD)  # a tenth smaller than LZ4
        self._guarded(lambda: self._writer.start(library="trihedron"))
        self._waiting: list[tuple[int, int, bytes]] = []
        self._waiting_bytes, self._closing = 0, False
        self._handed, self._writing = threading.Condition(), threading.Lock()
        self._thread = threading.Thread(target=self._work, name=f"writer of {path.name}", daemon=True)
        self._thread.start()

    failure: OSError | None

    def metadata(self, name: str, content: dict[str, str]) -> None:
        """Add a metadata record."""
        with self._writing:
            self._guarded(lambda: self._writer.add_metadata(name, content))

    def attach(self, name: str, text: str) -> None:
        """Add a text file."""
        with self._writing:
            self._guarded(lambda: self._writer.add_attachment(0, 0, name, "text/plain", text.encode()))

    def channel(self, topic: str, schema: str, encoding: str, definition: bytes, message_encoding: str) -> int:
        """Declare a channel with a schema of its own; returns its number."""
        with self._writing:
            schema_id = self._writer.register_schema(schema, encoding, definition)
            return int(self._writer.register_channel(topic, message_encoding, schema_id))

    def add(self, channel: int, stamp_ns: int, data: bytes) -> None:
        """Hand a message over."""
        with self._handed:
            self._waiting.append((channel, stamp_ns, data))
            self._waiting_bytes += len(data) + MESSAGE_OVERHEAD
            if self._waiting_bytes > CHUNK_BYTES:
                self._handed.notify_all()
            self._handed.wait_for(lambda: self._waiting_bytes < MOST_WAITING)

    def close(self) -> None:
        """Write what waits, and the index; the file is complete only then. Raises RecordingError when that, or anything before, failed."""
        if not self._file.closed:
            with self._handed:
                self._closing = True
                self._handed.notify_all()
            self._thread.join()
            self._guarded(self._writer.finish)
            self._file.close()
            if self.failure is not None:
                cure = f"what was written before is kept; index it with: trihedron recover {self.path}"
                raise RecordingError(str(self.path), f"cannot be written: {self.failure.strerror}", cure) from self.failure

    def _work(self) -> None:
        closing = False
        while not closing:
            with self._handed:
                self._handed.wait_for(lambda: self._closing or self._waiting_bytes > CHUNK_BYTES, timeout=CHUNK_SECONDS)
                waiting, self._waiting, self._waiting_bytes, closing = self._waiting, [], 0, self._closing
                self._handed.notify_all()
            if waiting:
                with self._writing:
                    self._guarded(lambda messages=waiting: self._write(messages))

    def _write(self, messages: list[tuple[int, int, bytes]]) -> None:
        for channel, stamp_ns, data in messages:
            if self._chunk_bytes + len(data) + MESSAGE_OVERHEAD > CHUNK_BYTES:
                self._end_chunk()
            self._writer.add_message(channel, log_time=stamp_ns, data=data, publish_time=stamp_ns)
            self._chunk_bytes += len(data) + MESSAGE_OVERHEAD
        self._end_chunk()
        self._file.sync()

    def _end_chunk(self) -> None:
        self._writer.flush()
        self._whole, self._chunk_bytes = self._file.tell(), 0

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
