"""Damaged files against every reader: whatever is in them, a reader gives values or one of its declared errors, soon and in little memory.

    python tests/fuzz/fuzz_readers.py --inputs 100000        # all readers; prints a line for each
    python tests/fuzz/fuzz_readers.py --inputs 2000 --only ros,map --seed 7
    python tests/fuzz/fuzz_readers.py --seeds                # writes tests/fuzz/seeds anew

An input is one of the seeds, changed at random: bits, bytes, lengths, spans cut out, doubled, moved in from another seed, the end cut off. Files of
MCAP are also changed inside their messages, which then come through all checks of the container. An input that breaks a reader is written to
tests/fuzz/found, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import logging
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from trihedron.datasets import foxglove_messages
from trihedron.datasets.cameras import read_camera_file
from trihedron.datasets.icl_nuim import IclNuim
from trihedron.datasets.images import UnreadableImage, decode_image, read_color, read_depth
from trihedron.datasets.lists import read_file_list
from trihedron.datasets.matrices import read_matrix, trajectory_of
from trihedron.datasets.mcap import McapDataset
from trihedron.datasets.pixels import color_of, depth_of, kind_of
from trihedron.datasets.replica import read_parameters
from trihedron.datasets.robot_streams import ROS
from trihedron.datasets.robot_values import Picture, UnreadableMessage
from trihedron.datasets.trajectories import read_trajectory
from trihedron.pipeline.codec import Decoder
from trihedron.pipeline.errors import TrihedronError
from trihedron.pipeline.mcap_file import McapFile
from trihedron.pipeline.recording import METADATA, Recording
from trihedron.pipeline.state import load_map

HERE = Path(__file__).parent
SEEDS, FOUND = HERE / "seeds", HERE / "found"
DECLARED = (TrihedronError, UnreadableImage, UnreadableMessage)
CPU_SECONDS = 10  # of one input
MEMORY = 2 << 30  # beyond what the program itself has mapped
MAGIC_NUMBERS = [0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1]
WORDS = [
    b"nan",
    b"inf",
    b"-inf",
    b"1e400",
    b"-1",
    b"0",
    b"9" * 400,
    b"#",
    b",",
    b"\n",
    b"\x00",
    b"\xff",
    b"../../etc/passwd",
    b"1e-400",
    b"!!python/object:os.system",
]


class Hang(Exception):
    """An input took too long."""


def lists(path: Path) -> None:
    """rgb.txt and depth.txt of the TUM layout."""
    read_file_list(path)


def associations(path: Path) -> None:
    """The associations of ICL-NUIM, with a folder about them."""
    (path.parent / "associations.txt").write_bytes(path.read_bytes())
    len(IclNuim(str(path.parent)))


def matrices(path: Path) -> None:
    """Poses as 4 × 4 numbers."""
    trajectory_of(np.array([0]), [read_matrix(path)], [str(path)])


def frames(path: Path) -> None:
    """dataset=mcap, whoever recorded it."""
    dataset = McapDataset(str(path))
    for index in range(min(len(dataset), 3)):
        dataset(index)
    dataset.truth()
    if METADATA not in McapFile(path).metadata:
        McapDataset(str(path), truth_from="map").truth()


def recording(path: Path) -> None:
    """All topics of a recording, and one frame."""
    opened = Recording(path)
    opened.overrides()
    for topic in sorted(opened.topics):
        for _ in opened.values(topic):
            pass
    opened.frame(2)


def pictures(path: Path) -> None:
    """PNG and JPEG, as colour and as depth, from a file and from a message."""
    for read in (read_color, lambda file: read_depth(file, 1000.0), lambda file: decode_image(file.read_bytes())):
        try:
            read(path)
        except DECLARED:
            continue


def message(path: Path) -> None:
    """One message: the first byte says of which type; images go on to their pixels."""
    data = path.read_bytes()
    readers: list[Callable[[bytes], Any]] = [decode for _, decode in ROS.values()]
    readers += [foxglove_messages.reader(kind, encoding) for kind in foxglove_messages.READERS for encoding in ("protobuf", "json")]
    readers += [Decoder("message").decode]
    value = readers[data[0] % len(readers)](data[1:]) if data else None
    if isinstance(value, Picture):
        for use in (kind_of, color_of, lambda picture: depth_of(picture, 1000.0)):
            try:
                use(value)
            except DECLARED:
                continue


TARGETS: dict[str, tuple[str, Callable[[Path], Any], float]] = {  # name -> pattern of its seeds, reader, share of the inputs
    "lists": ("list*.txt", lists, 0.15),
    "associations": ("associations*.txt", associations, 0.03),
    "cameras": ("camera*.yaml", read_camera_file, 0.07),
    "parameters": ("cam_params*.json", read_parameters, 0.05),
    "trajectories": ("trajectory*.txt", read_trajectory, 0.15),
    "matrices": ("matrix*.txt", matrices, 0.05),
    "pictures": ("picture*", pictures, 0.1),
    "messages": ("message*", message, 0.2),
    "recordings": ("own*.mcap", recording, 0.05),
    "frames": ("own*.mcap", frames, 0.03),
    "map": ("map*.mcap", load_map, 0.03),
    "ros": ("ros*.mcap", frames, 0.06),
    "foxglove": ("foxglove*.mcap", frames, 0.03),
}


@dataclass
class Tally:
    """What became of the inputs of one reader."""

    inputs: int = 0
    read: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    broke: list[str] = field(default_factory=list)
    seconds: float = 0.0


def changed(data: bytes, others: list[bytes], rng: np.random.Generator) -> bytes:
    """One to four random changes."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at, length = int(rng.integers(0, len(out) + 1)), int(rng.integers(1, 33))
        kind = int(rng.integers(0, 9))
        if kind == 0 and at < len(out):
            out[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1 and at < len(out):
            out[at] = int(rng.integers(0, 256))
        elif kind == 2:
            del out[at : at + length]
        elif kind == 3:
            out[at:at] = out[at : at + length] * int(rng.integers(1, 4))
        elif kind == 4:
            other = others[int(rng.integers(0, len(others)))]
            begin = int(rng.integers(0, len(other) + 1))
            out[at : at + length * int(rng.integers(0, 2))] = other[begin : begin + length]
        elif kind == 5:
            size, number = int(rng.choice([1, 2, 4, 8])), MAGIC_NUMBERS[int(rng.integers(0, len(MAGIC_NUMBERS)))]
            out[at : at + size] = (number & ((1 << 8 * size) - 1)).to_bytes(size, "little" if rng.random() < 0.7 else "big")
        elif kind == 6:
            word = WORDS[int(rng.integers(0, len(WORDS)))]
            out[at : at + int(rng.integers(0, 4))] = word
        elif kind == 7 and rng.random() < 0.3:
            del out[at:]
        elif kind == 8:
            out[at : at + length] = rng.bytes(length)
    return bytes(out)


def changed_inside(data: bytes, others: list[bytes], rng: np.random.Generator) -> bytes:
    """An MCAP file with one of its messages, or what is said of its channels, changed, packed again so that everything about it fits."""
    target = BytesIO()
    reader = make_reader(BytesIO(data))
    writer = Writer(target, compression=list(CompressionType)[int(rng.integers(0, len(CompressionType)))], chunk_size=int(rng.integers(500, 20_000)))
    writer.start()
    for metadata in reader.iter_metadata():
        texts = metadata.metadata
        if rng.random() < 0.1 and texts:
            key = sorted(texts)[int(rng.integers(0, len(texts)))]
            texts[key] = changed(texts[key].encode(), others, rng).decode("utf-8", "replace")
        writer.add_metadata(metadata.name, texts)
    for attachment in reader.iter_attachments():
        writer.add_attachment(
            0, 0, attachment.name, attachment.media_type, changed(attachment.data, others, rng) if rng.random() < 0.2 else attachment.data
        )
    stored = list(reader.iter_messages(log_time_order=False))
    chosen = {int(rng.integers(0, len(stored)))}
    channels: dict[int, int] = {}
    for row, (schema, channel, sent) in enumerate(stored):
        if channel.id not in channels:
            assert schema is not None
            kind = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
        content = changed(sent.data, others, rng) if row in chosen else sent.data
        writer.add_message(channels[channel.id], sent.log_time, content, sent.publish_time)
    writer.finish()
    return target.getvalue()


def inputs(name: str, rng: np.random.Generator) -> Iterator[bytes]:
    """Changed seeds without end, the seeds themselves first."""
    seeds = [file.read_bytes() for file in sorted(SEEDS.glob(TARGETS[name][0]))]
    assert seeds, f"no seeds of {name}"
    yield from seeds
    while True:
        seed = seeds[int(rng.integers(0, len(seeds)))]
        inside = name in ("recordings", "frames", "map", "ros", "foxglove") and rng.random() < 0.5
        yield changed_inside(seed, seeds, rng) if inside else changed(seed, seeds, rng)


def fuzz(name: str, count: int, seed: int) -> Tally:
    """Give a reader `count` inputs."""
    tally, reader = Tally(), TARGETS[name][1]
    log = logging.getLogger("trihedron")
    level = log.level
    log.setLevel(logging.CRITICAL)
    rng = np.random.default_rng([seed, *name.encode()])
    began = time.process_time()
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        path = Path(folder) / "input.mcap"
        for data in inputs(name, rng):
            if tally.inputs == count:
                break
            tally.inputs += 1
            path.write_bytes(data)
            try:
                with limited_time():
                    reader(path)
                tally.read += 1
            except DECLARED as error:
                tally.refused[type(error).__name__] += 1
                if "\n" in str(error):
                    tally.broke.append(f"more than one line: {error!r}")
            except Exception:
                FOUND.mkdir(exist_ok=True)
                (FOUND / f"{name}_{tally.inputs}").write_bytes(data)
                tally.broke.append(traceback.format_exc())
            outside = [entry for entry in Path(folder).iterdir() if entry.name not in ("input.mcap", "associations.txt")]
            assert not outside, f"{name}: wrote {outside}"
    log.setLevel(level)
    tally.seconds = time.process_time() - began
    return tally


class limited_time:
    """Raises Hang after CPU_SECONDS of this process's own time: a machine that is busy with others does not count."""

    def __enter__(self) -> None:
        signal.signal(signal.SIGVTALRM, self._stop)
        signal.setitimer(signal.ITIMER_VIRTUAL, CPU_SECONDS)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        raise Hang(f"more than {CPU_SECONDS} s")

    def __exit__(self, *exception: object) -> None:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)


def main(argv: list[str]) -> int:
    """The command; see the top of the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000, help="in all (default 100000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help=f"some of {','.join(TARGETS)}")
    parser.add_argument("--seeds", action="store_true", help="write the seeds anew")
    arguments = parser.parse_args(argv)
    if arguments.seeds:
        sys.path.insert(0, str(HERE))
        from make_seeds import make_seeds

        make_seeds(SEEDS)
        return 0
    sys.stderr = os.fdopen(os.dup(2), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng and libjpeg complain there
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY, resource.RLIM_INFINITY))
    chosen = arguments.only.split(",") if arguments.only else list(TARGETS)
    share = sum(TARGETS[name][2] for name in chosen)
    broke = total = 0
    for name in chosen:
        tally = fuzz(name, -(-int(arguments.inputs * TARGETS[name][2] * 1e6 / share) // 1_000_000), arguments.seed)
        refused = ", ".join(f"{count} {kind}" for kind, count in tally.refused.most_common())
        print(
            f"{name:13} {tally.inputs:6} inputs: {tally.read} read, {refused or 'none refused'}, {len(tally.broke)} broke it; {tally.seconds:.1f} s",
            flush=True,
        )
        for text in sorted(set(tally.broke), key=tally.broke.index)[:3]:
            print(text)
        broke, total = broke + len(tally.broke), total + tally.inputs
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"{total} inputs, {broke} broke a reader; at most {peak:.0f} MB")
    return 1 if broke else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
