"""Write an MCAP file that a kill costs less than a second of.

Messages are handed over as functions; a thread of the writer calls them, and foxglove-sdk packs what they return. It ends a chunk at `CHUNK_BYTES`,
and whatever there is every `FLUSH_SECONDS`, so that encoding, compression and the disk wait beside the run. `trihedron recover` gives a file that
was cut off its index.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import foxglove
from foxglove.mcap import MCAPWriteOptions

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.files import new_file, open_file
from trihedron.pipeline.record.foxglove_server import FoxgloveServer
from trihedron.pipeline.record.mcap_file import is_being_written

log = logging.getLogger("trihedron")
Messages = Iterable[tuple[int, int, bytes]]  # channel, log time in ns, content
CHUNK_BYTES = 4 << 20  # an entry of the index is worth more messages
FLUSH_SECONDS = 0.4
LIVE_SECONDS = 0.03  # between two looks at the queue where a viewer waits
LEVEL = 1  # of zstd: 2 takes a quarter more time for 7 % fewer bytes
MESSAGE_OVERHEAD = 64  # bytes of a message beside its data, generously
MAX_QUEUE_BYTES = 64 << 20  # a run that is faster than the disk waits from there on


@contextmanager
def new_recording(path: Path, cure: str) -> Iterator[Path]:
    """Lend the path of a recording for the block to write and close, as `new_file` does. Raises RecordingError, which names `path`."""
    new = path
    try:
        with new_file(path) as new:
            yield new
    except OSError as error:
        raise RecordingError(str(path), f"cannot be written: {error.strerror}", cure) from error
    except RecordingError as error:
        raise error if error.place != str(new) else RecordingError(str(path), error.cause, cure) from error


class McapWriter:
    """One file, or none; `server` sends the same messages to viewers at once. Once the disk refuses the file, a warning reports that, what follows is
    dropped, so that the run can go on, and `close` raises RecordingError."""

    def __init__(self, path: Path | None, server: FoxgloveServer | None = None, flush_s: float = FLUSH_SECONDS) -> None:
        """`flush_s` is the most that a kill may cost. Raises RecordingError when the file cannot be written or another process is writing it."""
        self.path, self._flush_s = path, flush_s
        self._server = server
        self._context = server.context if server is not None else foxglove.Context()
        self._period_s = LIVE_SECONDS if server is not None else flush_s
        self._file = _File(path) if path is not None else None
        options = MCAPWriteOptions(chunk_size=CHUNK_BYTES, compression_level=LEVEL, compression_threads=0, disable_seeking=True)
        self._writer = foxglove.open_mcap(self._file, context=self._context, writer_options=options) if self._file is not None else None
        self._channels: list[foxglove.Channel] = []
        self._queue: deque[tuple[int, Callable[[], Messages]]] = deque()
        self._queued_bytes, self._taken_bytes = 0, 0  # each is written by one thread alone, so that queueing a message takes no lock
        self._closing = False
        self._mistake: BaseException | None = None  # of a queued function
        self._enough, self._room, self._writing = threading.Event(), threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._work, name=f"writer of {path}", daemon=True)
        self._thread.start()

    @property
    def failure(self) -> OSError | None:
        """Why the disk refused the file, or None."""
        return self._file.failure if self._file is not None else None

    def metadata(self, name: str, content: dict[str, str]) -> None:
        """Add a metadata record."""
        if self._writer is not None:
            with self._writing:
                self._writer.write_metadata(name, content)

    def attach(self, name: str, text: str) -> None:
        """Add a text file."""
        if self._writer is not None:
            with self._writing:
                self._writer.attach(log_time=0, create_time=0, name=name, media_type="text/plain", data=text.encode())

    def channel(
        self, topic: str, schema: str, encoding: str, definition: bytes, message_encoding: str, metadata: dict[str, str] | None = None
    ) -> int:
        """Declare a channel; returns its number. For the queued functions to call: no other thread writes then."""
        described = foxglove.Schema(name=schema, encoding=encoding, data=definition)
        self._channels.append(foxglove.Channel(topic, schema=described, message_encoding=message_encoding, context=self._context, metadata=metadata))
        return len(self._channels) - 1

    def add(self, size: int, make: Callable[[], Messages]) -> None:
        """Queue a function that makes messages, and the approximate bytes of memory that it holds. The writer's thread calls it, in the order of the
        calls; what it raises is raised by the next call, or by `close`, and ends the file there."""
        if self._mistake is not None:
            raise self._mistake
        self._queued_bytes += size + MESSAGE_OVERHEAD
        self._queue.append((size + MESSAGE_OVERHEAD, make))
        if self._queued_bytes - self._taken_bytes > CHUNK_BYTES:
            self._enough.set()
            self._room.clear()
            while self._queued_bytes - self._taken_bytes > MAX_QUEUE_BYTES:
                self._room.wait(FLUSH_SECONDS)
                self._room.clear()

    def flush(self) -> None:
        """Write what is queued."""
        with self._writing:
            self._take_all()
            self._end_chunk()

    def close(self) -> None:
        """Write what is queued, and the index; the file is complete only then. Raises RecordingError when that, or anything before, failed."""
        if self._closing:
            return
        self._closing = True
        self._enough.set()
        self._thread.join()
        if self._writer is not None:
            self._writer.close()
        if self._server is None:  # else they stay until the server ends
            for channel in self._channels:
                channel.close()
        if self._file is not None:
            self._file.close()
        if self._mistake is not None:
            raise self._mistake
        if self.failure is not None:
            cure = f"what was written before is kept; index it with: trihedron recover {self.path}"
            raise RecordingError(str(self.path), f"cannot be written: {self.failure.strerror}", cure) from self.failure

    def _work(self) -> None:
        closing = pending = False
        flushed_s = time.monotonic()
        while not closing:
            self._enough.wait(self._period_s)
            self._enough.clear()
            closing = self._closing
            with self._writing:
                pending = self._take_all() or pending
                if pending and (closing or self._period_s == self._flush_s or time.monotonic() - flushed_s >= self._flush_s):
                    self._end_chunk()
                    pending, flushed_s = False, time.monotonic()
            self._room.set()

    def _take_all(self) -> bool:
        """Write the messages of all queued functions; return True if there were any."""
        count = len(self._queue)
        for _ in range(count):
            self._take()
        return count > 0

    def _end_chunk(self) -> None:
        """End the chunk, and wait until the disk has it."""
        if self._writer is not None and self._file is not None:
            self._writer.flush()
            self._file.sync()

    def _take(self) -> None:
        """Write the messages of the oldest queued function."""
        size, make = self._queue.popleft()
        if self._mistake is None and self.failure is None:
            try:
                for number, log_time, data in list(make()):
                    channel = self._channels[number]
                    channel.log(data, log_time=log_time)
                    if self._server is not None:
                        self._server.remember(channel, log_time, data)
            except Exception as error:
                self._mistake = error
        self._taken_bytes += size
        if not self._room.is_set():
            self._room.set()


class _File:
    """The file for foxglove-sdk, which only appends: without a buffer, so that a killed process cannot lose what `write` returned from. The first
    error of the disk is kept in `failure`, and everything later dropped."""

    def __init__(self, path: Path) -> None:
        """Make the file, in the place of whatever lies there, and lock it for this process. Raises RecordingError."""
        self.path, self._position = path, 0
        self.failure: OSError | None = None
        try:
            if path.exists() and not path.is_symlink():
                with open_file(path) as older:
                    if is_being_written(older.fileno()):
                        cure = "wait until that has ended, or give another out=FOLDER"
                        raise RecordingError(str(path), "is being written by another process", cure)
            path.unlink(missing_ok=True)
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise RecordingError(str(path), f"cannot be written: {error.strerror}", "give another out=FOLDER") from error
        is_being_written(self._descriptor)  # the lock

    def write(self, data: bytes | bytearray) -> int:
        rest = memoryview(data)
        try:
            while rest and self.failure is None:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError as error:
            self.failure = error
            log.warning("%s: cannot be written: %s; the rest is done without it", self.path, error.strerror)
        self._position += len(data)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Return the position, the only one there is."""
        return self._position

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def sync(self) -> None:
        """Wait until the disk has what was written."""
        if self.failure is None and os.fstat(self._descriptor).st_size:
            os.fdatasync(self._descriptor)

    def close(self) -> None:
        os.close(self._descriptor)
