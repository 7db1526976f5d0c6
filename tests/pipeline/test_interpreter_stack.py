"""Room on the interpreter's stack: calls within map no memory, and results and errors pass through."""

import resource
import threading

import pytest

from trihedron.pipeline.run.interpreter_stack import call_with_room

DEPTH, CALLS = 160, 50


def _descend(depth):
    """Call a function CALLS times at each depth; every frame has 1 KB, so a chunk of 16 KB ends at each sixteenth."""
    for _ in range(CALLS):
        _leaf()
    if depth:
        _descend(depth - 1)


def _leaf():
    pass


for function in (_descend, _leaf):
    function.__code__ = function.__code__.replace(co_stacksize=128)


def _page_faults():
    before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
    _descend(DEPTH)
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before


@pytest.mark.skipif(not hasattr(resource, "RUSAGE_THREAD"), reason="only Linux counts the page faults of a thread")
def test_calls_at_any_depth_map_no_memory():
    faults = []
    thread = threading.Thread(target=call_with_room, args=(lambda: faults.append(_page_faults()),))
    thread.start()
    thread.join()
    assert faults[0] < 3 * DEPTH  # 40 pages of stack; without room each call at the end of a chunk has one to four


def test_result_and_arguments_pass_through():
    assert call_with_room(divmod, 7, 2) == (3, 1) and call_with_room(dict, a=1) == {"a": 1}


def test_errors_pass_through():
    with pytest.raises(ZeroDivisionError):
        call_with_room(divmod, 1, 0)
