"""Threads share one heap of the C library, in a process of its own: what it has it keeps."""

import ctypes
import subprocess
import sys

import pytest

HEAPS = """
import ctypes, sys, threading
from pathlib import Path
from trihedron.pipeline.run import memory
libc = ctypes.CDLL(None)
libc.fopen.restype = libc.malloc.restype = ctypes.c_void_p
if sys.argv[1] == "shared":
    memory.configure_malloc()
for _ in range(4):
    thread = threading.Thread(target=lambda: [bytearray(10_000) for _ in range(100)])
    thread.start()
    thread.join()
file = ctypes.c_void_p(libc.fopen(sys.argv[2].encode(), b"w"))
libc.malloc_info(0, file)
libc.fclose(file)
print(Path(sys.argv[2]).read_text().count("<heap "))
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_info"), reason="another C library has no such heaps")
def test_threads_share_one_heap(tmp_path):
    def heaps(how):
        return int(subprocess.run([sys.executable, "-c", HEAPS, how, tmp_path / how], check=True, stdout=subprocess.PIPE, text=True).stdout)

    assert heaps("each its own") > 1 and heaps("shared") == 1
