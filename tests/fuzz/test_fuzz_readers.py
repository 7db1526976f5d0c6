"""No damaged file breaks a reader: a short round of the fuzzer, the same every time, and the long one."""

import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from fuzz_readers import FOUND, SEEDS, STRUCTURED, TARGETS, fuzz

from trihedron.pipeline.core.errors import RecordingError

OLDER = {"message_legacy_map", "message_legacy_pose"}  # types that have changed since: `trihedron convert` upgrades what can be read
FEW = {name: 30 if name == "configurations" else 130 for name in TARGETS}


@pytest.mark.parametrize("name", TARGETS)
def test_every_seed_is_read(name, tmp_path):
    """What is damaged was whole: of a recording frames come, of a list files, of a map its values, and so on."""
    pattern, reader, _ = TARGETS[name]
    seeds = sorted(SEEDS.glob(pattern))
    assert seeds
    for seed in seeds:
        path = tmp_path / "input.mcap"
        path.write_bytes(seed.read_bytes())
        if seed.name in OLDER:
            with pytest.raises(RecordingError, match="upgrade what can be read of it with: trihedron convert"):
                reader(path)
        else:
            assert reader(path) > 0, seed.name


@pytest.mark.parametrize("name", TARGETS)
def test_a_few_inputs(name):
    tally = fuzz(name, FEW[name], seed=3)
    assert tally.inputs == FEW[name] and not tally.broke, tally.broke[0]
    assert tally.read >= len(list(SEEDS.glob(TARGETS[name][0])))


def test_every_reader_has_a_generator():
    assert TARGETS.keys() == STRUCTURED.keys() and sum(FEW.values()) >= 1900


@pytest.mark.slow
def test_a_hundred_thousand_inputs():
    """The command in a process of its own, which may map 1 GB more than it has when it begins."""
    command = [sys.executable, str(Path(__file__).parent / "fuzz_readers.py"), "--inputs", "100000"]
    done = subprocess.run(command, capture_output=True, text=True)
    print(done.stdout)
    assert done.returncode == 0, f"inputs in {FOUND}: {done.stdout[-3000:]}"
