"""Threads share one heap of the C library, in a process of its own: what it has it keeps."""

import subprocess
import sys

import pytest

HEAPS = """
import ctypes, sys, threading
from pathlib import Path
from trihedron.pipeline import heap
libc = ctypes.CDLL(None)
libc.fopen.restype = libc.malloc.restype = ctypes.c_void_p
if sys.argv[1] == "shared":
    heap.configure_malloc()
for _ in range(4):
    thread = threading.Thread(target=lambda: [bytearray(10_000) for _ in range(100)])
    thread.start()
    thread.join()
file = ctypes.c_void_p(libc.fopen(sys.argv[2].encode(), b"w"))
libc.malloc_info(0, file)
libc.fclose(file)
print(Path(sys.argv[2]).read_text().count("<heap "))
"""


def test_threads_share_one_heap(tmp_path):
    def heaps(how):
        done = subprocess.run([sys.executable, "-c", HEAPS, how, tmp_path / how], capture_output=True, text=True)
        return int(done.stdout) if done.returncode == 0 else pytest.skip("another C library has no such heaps")

    assert heaps("each its own") > 1 and heaps("shared") == 1
