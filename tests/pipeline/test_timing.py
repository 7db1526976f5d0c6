"""Memory of a run is its own, whatever ran before it in the process."""

import json
import subprocess
import sys

import pytest

from trihedron.pipeline.app.cli import main

PROGRAM = """
import json, numpy as np
from trihedron.pipeline.run.timing import Timing, resident_mb

MB = 1_000_000

def memory_of_a_run(megabytes):
    timing = Timing()
    timing.begin()
    np.ones(megabytes * MB, np.uint8)
    return timing.summary(1, 1.0, 0.0)

"""


def printed_by(program):
    """What a new process prints, as JSON: its peak knows nothing of the tests before this one."""
    done = subprocess.run([sys.executable, "-c", PROGRAM + program], capture_output=True, text=True, check=True, timeout=60)
    return json.loads(done.stdout)


def test_memory_of_a_run_is_its_growth_above_what_earlier_runs_left():
    alone, later = printed_by("""
alone = memory_of_a_run(40)
left = np.ones(200 * MB, np.uint8)  # by earlier runs
memory_of_a_run(120)
print(json.dumps([alone, memory_of_a_run(40)]))
""")
    assert alone["own_memory_mb"] == pytest.approx(40.0, abs=5.0) == pytest.approx(later["own_memory_mb"], abs=5.0)
    assert later["peak_memory_mb"] - alone["peak_memory_mb"] == pytest.approx(280.0, abs=20.0)


def test_the_peak_of_the_process_counts_what_was_before_the_first_frame():
    before, found = printed_by("""
before = resident_mb()
np.ones(150 * MB, np.uint8)  # the warm-up
print(json.dumps([before, memory_of_a_run(10)]))
""")
    assert found["peak_memory_mb"] == pytest.approx(before + 150.0, abs=20.0) and found["own_memory_mb"] < 15.0


@pytest.mark.slow
def test_memory_of_a_job_does_not_grow_with_the_jobs_before_it(tmp_path):
    small = ["dataset.width=160", "dataset.height=120", "dataset.length=12"]
    large = ["dataset.width=640", "dataset.height=480", "dataset.length=6"]
    found = []
    for number, words in enumerate([small, small, large, small]):  # the first loads libraries after its first frame
        assert main(["run", *words, f"out={tmp_path / str(number)}"]) == 0
        found.append(json.loads((tmp_path / str(number) / "timing.json").read_text())["own_memory_mb"])
    assert found[3] == pytest.approx(found[1], abs=15.0) and found[2] > found[3]
