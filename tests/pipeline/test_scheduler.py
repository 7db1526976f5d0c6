"""The scheduler: wires mean what they say, and neither thread count nor duration changes a value."""

import random
import sys
import threading
import time
from types import SimpleNamespace

import cv2
import pytest
from threadpoolctl import threadpool_info

from trihedron.pipeline.core.wires import PREVIOUS, Wire
from trihedron.pipeline.run import scheduler
from trihedron.pipeline.run.kept_values import KeptValues
from trihedron.pipeline.run.node import Node, NodeFailure, consumers_of, lagging_nodes
from trihedron.pipeline.run.readiness import Readiness
from trihedron.pipeline.run.scheduler import Scheduler, single_threaded_libraries
from trihedron.pipeline.run.task_order import ReadyTasks, TaskOrder

NET_S = 120.0  # after which what waits for another thread fails: no measure of speed


def run(nodes, count, threads=2, lookahead=3, initial=None):
    return [dict(values) for _, values in Scheduler(nodes, threads, lookahead, initial or {}).run(count)]


def jitter():
    time.sleep(random.random() * 0.002)


def test_same_frame_previous_and_exact_delay():
    nodes = [
        Node("source", lambda k, v: k if k % 3 else None, {}),
        Node("held", lambda k, v: (k, v["x"]), {"x": Wire("source", PREVIOUS)}),
        Node("exact", lambda k, v: (k, v["x"]), {"x": Wire("source", 2)}),
        Node("now", lambda k, v: (k, v["x"]), {"x": Wire("source")}),
    ]
    frames = run(nodes, 6)
    assert [f["now"][1] for f in frames] == [None, 1, 2, None, 4, 5]
    assert [f["held"][1] for f in frames] == [None, None, 1, 2, 2, 4]  # the latest earlier value, kept over frames without one
    assert [f["exact"][1] for f in frames] == [None, None, None, 1, 2, None]  # the value of exactly two frames ago, or None


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_values_do_not_depend_on_threads_or_durations(threads):
    def slow(function):
        return lambda k, v: (jitter(), function(k, v))[1]

    nodes = [
        Node("a", slow(lambda k, v: k), {}),
        Node("b", slow(lambda k, v: v["a"] + (v["state"] or 0)), {"a": Wire("a"), "state": Wire("b", PREVIOUS)}),
        Node("late", slow(lambda k, v: (time.sleep(0.004), v["b"] * 2)[1]), {"b": Wire("b")}),
        Node("c", slow(lambda k, v: (v["b"], v["late"])), {"b": Wire("b"), "late": Wire("late", 3)}),
    ]
    frames = run(nodes, 40, threads)
    assert [f["b"] for f in frames] == [k * (k + 1) // 2 for k in range(40)]
    assert [f["c"][1] for f in frames] == [None] * 3 + [k * (k + 1) for k in range(37)]


def test_ordered_nodes_never_run_out_of_order_and_frames_in_flight_are_bounded():
    seen, flying, most = [], set(), []
    lock = threading.Lock()

    def source(k, v):
        with lock:
            flying.add(k)
            most.append(len(flying))
        jitter()
        return k

    def sink(k, v):
        jitter()
        with lock:
            flying.discard(k)
        return k

    nodes = [Node("source", source, {}), Node("fold", lambda k, v: (jitter(), seen.append(k))[0], {"x": Wire("source")}, ordered=True),
             Node("sink", sink, {"x": Wire("source")})]  # fmt: skip
    run(nodes, 60, threads=4, lookahead=3)
    assert seen == list(range(60))
    assert max(most) <= 3


def test_initial_value_is_what_previous_holds_before_the_first_frame():
    nodes = [Node("a", lambda k, v: (v["p"] or 0) + 1, {"p": Wire("a", PREVIOUS)})]
    assert [f["a"] for f in run(nodes, 3, initial={"a": 10})] == [11, 12, 13]


@pytest.mark.parametrize("threads", [1, 3])
def test_failure_comes_after_the_frames_before_it_and_the_rest_of_its_own(threads):
    def fails(k, v):
        if k == 4:
            raise ValueError("no")
        return k

    nodes = [Node("a", lambda k, v: k, {}), Node("b", fails, {"a": Wire("a")}), Node("c", lambda k, v: k, {"b": Wire("b")}),
             Node("d", lambda k, v: (time.sleep(0.003), k)[1], {"a": Wire("a")})]  # fmt: skip
    done = []
    with pytest.raises(NodeFailure) as failure:
        for position, values in Scheduler(nodes, threads, 3, {}).run(10):
            done.append((position, sorted(values)))
    assert done == [(k, ["a", "b", "c", "d"]) for k in range(4)] + [(4, ["a", "d"])]
    assert (failure.value.node, failure.value.position) == ("b", 4)
    assert isinstance(failure.value.__cause__, ValueError)


def test_later_frames_that_fail_too_do_not_hang():
    def fails(k, v):
        time.sleep(0.02 * k)
        raise ValueError("no")

    raised = []

    def run():
        try:
            list(Scheduler([Node("a", fails, {})], 2, 2, {}).run(10))
        except NodeFailure as failure:
            raised.append(failure.position)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(NET_S)
    assert raised == [0]


def test_memory_is_bounded_by_the_reach_of_the_wires():
    scheduler = Scheduler([Node("a", lambda k, v: k, {}), Node("b", lambda k, v: k, {"x": Wire("a", 4), "y": Wire("a", PREVIOUS)})], 2, 3, {})
    largest = 0
    for position, _ in scheduler.run(200):
        assert min(scheduler.kept.values["a"]) > position - 4 and position not in scheduler.kept.values["b"]  # which nobody asks for later
        largest = max(largest, *(len(values) for values in scheduler.kept.values.values()), *(len(held) for held in scheduler.kept.latest.values()))
    assert largest <= 4 + 3 + 5


def test_what_may_lag_takes_none_of_the_workers():
    """Two workers and the lagging node meet, which they can only on three threads."""
    meeting = threading.Barrier(3, timeout=NET_S)

    def meets(k, v):
        if k == 2:
            meeting.wait()
        return k

    nodes = [
        Node("left", meets, {"x": Wire("late", 2)}),
        Node("right", meets, {}),
        Node("late", lambda k, v: meets(k + 1, v), {"x": Wire("right")}),
    ]
    assert [values["left"] for values in run(nodes, 5)] == [0, 1, 2, 3, 4]


def test_of_a_frame_that_comes_first_after_which_most_remains(monkeypatch):
    """`alone`, named first, takes longer than `first`, but after `first` comes `long`: learned from the frames before."""
    seconds, order, now = {"alone": 0.004, "first": 0.001, "long": 0.02}, [], [0.0]
    monkeypatch.setattr(scheduler, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def takes(name):
        def call(k, v):
            order.append((k, name))
            now[0] += seconds[name]

        return call

    nodes = [Node("alone", takes("alone"), {}), Node("first", takes("first"), {}), Node("long", takes("long"), {"x": Wire("first")})]
    run(nodes, 4, threads=1, lookahead=1)
    assert next(name for k, name in order if k == 0) == "alone" and [name for k, name in order if k == 3] == ["first", "long", "alone"]


def test_what_waits_for_a_frame_takes_none_of_the_workers():
    """While frame 1 has not come, both workers meet at frame 0: it comes only after they did."""
    meeting, met = threading.Barrier(2, timeout=NET_S), threading.Event()

    def camera(k, v):
        if k:
            assert met.wait(NET_S)
        return k

    def meet(k, v):
        if k == 0:
            meeting.wait()
            met.set()
        return k

    first = Node("first", lambda k, v: (time.sleep(0.05), k)[1], {"x": Wire("camera")})  # by its end frame 1 is asked for
    nodes = [Node("camera", camera, {}, ordered=True, waits=True), first, *(Node(name, meet, {"x": Wire("first")}) for name in "ab")]
    assert run(nodes, threads=2, lookahead=2, count=3) == [dict.fromkeys(("camera", "first", "a", "b"), k) for k in range(3)]


CHAIN = [
    Node("a", lambda k, v: k, {}),
    Node("b", lambda k, v: k, {"x": Wire("a")}),
    Node("c", lambda k, v: k, {"x": Wire("b"), "before": Wire("c", PREVIOUS), "old": Wire("a", 2)}),
]


def test_what_is_kept_is_what_wires_can_still_read():
    kept = KeptValues(consumers_of(CHAIN), {"c": "initial"}, {"a": {-1: "recent"}})
    assert kept.read(Wire("c", PREVIOUS), 0) == "initial" and kept.read(Wire("a", 2), 1) == "recent" and kept.read(Wire("a", 2), 0) is None
    assert not kept.is_known(Wire("a"), 0) and kept.is_known(Wire("a", 2), 1) and kept.is_known(Wire("c", PREVIOUS), 0)
    assert list(kept.put("c", 1, "one")) == [] and not kept.is_known(Wire("c", PREVIOUS), 2)  # frame 0 is not done
    assert list(kept.put("c", 0, None)) == [1, 2] and kept.read(Wire("c", PREVIOUS), 1) == "initial" and kept.read(Wire("c", PREVIOUS), 2) == "one"
    for position in range(4):
        kept.put("a", position, position)
    assert kept.of_frame(1) == {"a": 1, "c": "one"}
    for position in range(3):
        kept.forget(position)
    assert kept.values["a"] == {1: 1, 2: 2, 3: 3} and kept.values["c"] == {}  # a@2 reads frame 1 at frame 3, @prev reads `latest`


def test_who_may_run_are_those_whose_wires_are_known():
    consumers = consumers_of(CHAIN)
    kept = KeptValues(consumers, {}, {})
    readiness = Readiness(CHAIN, consumers, kept)

    def done(name, position):
        return list(readiness.complete(name, position, kept.put(name, position, name)))

    assert list(readiness.admit(0)) == [("a", 0)] and list(readiness.admit(1)) == [("a", 1)]
    assert done("a", 1) == [("b", 1)] and done("b", 1) == []  # c waits for itself a frame before
    assert done("a", 0) == [("b", 0)] and done("b", 0) == [("c", 0)] and done("c", 0) == [("c", 1)]
    assert list(readiness.admit(2)) == [("a", 2)]
    readiness.forget(2)
    assert done("a", 2) == []


def test_the_order_is_by_frame_then_by_the_longest_way_to_its_end():
    nodes = [Node("short", lambda k, v: k, {}), Node("long", lambda k, v: k, {}), Node("end", lambda k, v: k, {"x": Wire("long")})]
    order, ready = TaskOrder(nodes, consumers_of(nodes)), ReadyTasks()
    for name, seconds in (("short", 2.0), ("long", 1.0), ("end", 3.0)):
        order.measure(name, seconds)
    order.update()
    for task in (("short", 1), ("long", 1), ("end", 0), ("short", 0)):
        ready.push(task, order.key(task))
    assert ready.oldest == 0 and len(ready) == 4
    assert [ready.pop() for _ in range(4)] == [("end", 0), ("short", 0), ("long", 1), ("short", 1)]


def test_what_only_later_frames_read_may_lag():
    nodes = [*CHAIN, Node("d", lambda k, v: k, {"x": Wire("b", 3)})]
    assert lagging_nodes(consumers_of(nodes)) == set() and lagging_nodes(consumers_of([CHAIN[0], Node("d", nodes[3].call, {"x": Wire("a", 3)})])) == {
        "a"
    }


def test_libraries_get_their_threads_back_in_whatever_order_runs_end():
    def settings():
        return cv2.getNumThreads(), sys.getswitchinterval(), [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]

    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(3)
        own = settings()
        first, second = single_threaded_libraries(), single_threaded_libraries()
        first.__enter__()
        within = settings()
        assert within[0] == 1 and set(within[2]) <= {1}
        second.__enter__()
        first.__exit__(None, None, None)
        assert settings() == within  # the second one still runs
        second.__exit__(None, None, None)
        assert settings() == own
    finally:
        cv2.setNumThreads(before)
