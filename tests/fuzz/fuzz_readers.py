"""Damaged files against every reader: whatever is in them, a reader gives values or one of its declared errors, soon and in little memory.

    python tests/fuzz/fuzz_readers.py --inputs 100000        # all readers; prints a line for each
    python tests/fuzz/fuzz_readers.py --inputs 2000 --only ros,map --seed 7
    python tests/fuzz/fuzz_readers.py --seeds                # writes tests/fuzz/seeds anew

Half of the inputs are seeds changed at random: bits, bytes, lengths, spans cut out, doubled, moved in from another seed, the end cut off. Files of
MCAP are also changed inside their messages, which then come through all checks of the container. The other half is well-formed and holds extreme
values (structured.py). An input that breaks a reader is written to tests/fuzz/found, and the exit code is 1. So is one that takes more than 5 s, or 1
GB beyond what the program had mapped when it began.
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
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from changes import changed, changed_inside
from structured import STRUCTURED
from targets import BESIDE, DECLARED, IN_CONTAINER, TARGETS

HERE = Path(__file__).parent
SEEDS, FOUND = HERE / "seeds", HERE / "found"
CPU_SECONDS = 5  # of one input
MEMORY = 1_000_000_000  # bytes, beyond what the program itself has mapped


class Hang(BaseException):
    """An input took too long; no Exception, which readers turn into their own."""


@dataclass
class Tally:
    """What became of the inputs of one reader."""

    inputs: int = 0
    read: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    broke: list[str] = field(default_factory=list)
    seconds: float = 0.0


def inputs(name: str, rng: np.random.Generator) -> Iterator[bytes]:
    """Changed seeds without end, the seeds themselves first."""
    seeds = [file.read_bytes() for file in sorted(SEEDS.glob(TARGETS[name][0]))]
    assert seeds, f"no seeds of {name}"
    yield from seeds
    while True:
        seed = seeds[int(rng.integers(0, len(seeds)))]
        if rng.random() < 0.5:
            yield STRUCTURED[name](seed, rng)
            continue
        inside = name in IN_CONTAINER and rng.random() < 0.5
        yield changed_inside(seed, seeds, rng) if inside else changed(seed, seeds, rng)


def fuzz(name: str, count: int, seed: int) -> Tally:
    """Give a reader `count` inputs."""
    tally, reader = Tally(), TARGETS[name][1]
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("error", RuntimeWarning)  # of NumPy: a number that is none went unseen
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
                    read = reader(path)
                tally.read += read > 0
                tally.refused["nothing in it"] += not read
            except DECLARED as error:
                tally.refused[type(error).__name__] += 1
                if "\n" in str(error) or len(str(error)) > 5000:
                    tally.broke.append(f"more than one bounded line: {error!r:.1000}")
                if out_of_memory(error):
                    tally.broke.append(f"{kept(name, tally, data)}: more than {MEMORY} bytes: {error!r:.1000}")
            except (Exception, Hang):
                tally.broke.append(f"{kept(name, tally, data)}: {traceback.format_exc()}")
            outside = [entry for entry in Path(folder).iterdir() if entry.name not in {path.name, *BESIDE}]
            assert not outside, f"{name}: wrote {outside}"
    logging.disable(logging.NOTSET)
    tally.seconds = time.process_time() - began
    return tally


def kept(name: str, tally: Tally, data: bytes) -> Path:
    """The file to which this input is written."""
    FOUND.mkdir(exist_ok=True)
    path = FOUND / f"{name}_{tally.inputs}"
    path.write_bytes(data)
    return path


def out_of_memory(error: BaseException | None) -> bool:
    """An error that a reader made of a MemoryError."""
    return error is not None and (isinstance(error, MemoryError) or out_of_memory(error.__cause__ or error.__context__))


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
        refused = ", ".join(f"{count} {kind}" for kind, count in tally.refused.most_common() if count)
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
