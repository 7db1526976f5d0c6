"""Times that other work on the machine changes least."""

import time


def fastest_ms(call, runs=10):
    """The shortest of several calls, ms."""
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - began))
    return min(times)
