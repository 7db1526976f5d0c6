"""Tables share chunks between versions, and equal a plain array."""

import mmap
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.table import CHUNK, Column, Table

RNG = np.random.default_rng(0)
SCHEMA = {"x": Column("f8", (3,)), "n": Column("i4")}


def rows(count, start=0):
    return {"x": np.arange(3 * count, dtype=float).reshape(count, 3) + start, "n": np.arange(start, start + count, dtype=np.int32)}


def test_append_and_read_across_chunks():
    table, whole = Table.empty(SCHEMA), []
    for start, count in [(0, 5), (5, CHUNK), (CHUNK + 5, 0), (CHUNK + 5, 3 * CHUNK + 1)]:
        table, ids = table.appended(**rows(count, start))
        assert ids.tolist() == list(range(start, start + count))
        whole.append(rows(count, start)["x"])
    whole = np.concatenate(whole)
    assert np.array_equal(table.column("x"), whole)
    ids = np.array([700, 0, 5, 5, len(table) - 1])
    assert np.array_equal(table.rows("x", ids), whole[ids])
    assert table.rows("x", np.empty(0, int)).shape == (0, 3)
    assert np.array_equal(table.row("x", 700), whole[700]) and not table.row("x", 700).flags.writeable


def test_rows_are_found_in_every_version_once_asked_for_in_one():
    """What a version knows of where its chunks lie is handed on, but of those that changed."""
    rng = np.random.default_rng(1)
    table, plain = Table.empty(SCHEMA), rows(0)
    for step in range(30):
        count = int(rng.integers(0, 2 * CHUNK))
        table, _ = table.appended(**rows(count, len(table)))
        plain = {name: np.concatenate([values, rows(count, len(values))[name]]) for name, values in plain.items()}
        if len(table):
            ids = rng.choice(len(table), min(len(table), 40), replace=False)
            values = rng.normal(size=(len(ids), 3))
            table, plain["x"][ids] = table.updated(ids, x=values), values
        if step % 5 == 4:
            dead = rng.choice(len(table) // CHUNK, 1)
            table = table.emptied(dead)
            for values in plain.values():
                values[int(dead[0]) * CHUNK : (int(dead[0]) + 1) * CHUNK] = 0
        for ids in (rng.permutation(len(table)), np.arange(0, len(table), 3, dtype=np.int32), np.arange(len(table))[::-2]):
            for name, values in zip(SCHEMA, table.columns_at(ids, *SCHEMA)):
                np.testing.assert_array_equal(values, plain[name][ids])
                assert values.dtype == SCHEMA[name].dtype


def test_versions_share_what_they_have_in_common():
    """An update copies its columns alone; new rows go behind the shared ones, once: a second branch gets memory of its own."""
    before, _ = Table.empty(SCHEMA).appended(**rows(4 * CHUNK))
    after = before.updated(np.array([1, CHUNK + 1]), n=np.array([-1, -2]))
    assert after.rows("n", np.array([1, CHUNK + 1, 2])).tolist() == [-1, -2, 2]
    assert before.rows("n", np.array([1])).tolist() == [1]
    assert after.same_memory("x", before) and not after.same_memory("n", before)
    longer, _ = before.appended(**rows(5, 4 * CHUNK))
    other, _ = before.appended(**rows(7, 1000))
    assert np.shares_memory(longer.shared("n"), before.shared("n")) and not np.shares_memory(other.shared("n"), before.shared("n"))
    assert longer.column("n")[-5:].tolist() == list(range(4 * CHUNK, 4 * CHUNK + 5)) and other.column("n")[-7:].tolist() == list(range(1000, 1007))
    assert len(before) == 4 * CHUNK and before.column("n").tolist() == list(range(4 * CHUNK))
    with pytest.raises(ValueError, match="read-only"):
        after.shared("n")[0] = 3
    with pytest.raises(ValueError, match="read-only"):
        after.row("x", 0)[0] = 3


def test_a_column_with_a_step_holds_multiples_of_it():
    """The nearest ones; columns without a step hold what they are given, and what is rounded already stays."""
    step, given = 2.0**-10, 3.0 + RNG.random((CHUNK + 5, 3))
    table, ids = Table.empty({"x": Column("f4", (3,), step), "y": Column("f8", (3,))}).appended(x=given, y=given)
    assert np.array_equal(table.column("x"), np.rint(given / step) * step) and np.array_equal(table.column("y"), given)
    assert np.abs(table.column("x") - given).max() <= 0.5 * step
    moved = table.updated(ids[-3:], x=given[:3], y=given[:3])
    assert np.array_equal(moved.rows("x", ids[-3:]), table.rows("x", ids[:3])) and np.array_equal(moved.rows("y", ids[-3:]), given[:3])
    again = moved.updated(ids, x=moved.column("x"))
    assert np.array_equal(again.column("x"), moved.column("x"))


def test_wrong_use_is_refused():
    table, _ = Table.empty(SCHEMA).appended(**rows(3))
    with pytest.raises(IndexError, match="row 3 of a table of 3"):
        table.rows("x", np.array([0, 3]))
    with pytest.raises(IndexError, match="row -1 of a table of 3"):
        table.rows("x", np.array([0, -1]))
    with pytest.raises(IndexError, match="row 3 of a table of 3"):
        table.row("x", 3)
    for outside in (-1, 3):
        with pytest.raises(IndexError, match="of a table of 3"):
            table.updated(np.array([0, outside]), n=np.zeros(2))
    with pytest.raises(ValueError, match="appended needs equally long columns"):
        table.appended(x=np.zeros((2, 3)), n=np.zeros(1))
    with pytest.raises(ValueError, match="appended needs equally long columns"):
        table.appended(x=np.zeros((2, 3)))


def test_several_columns_gathered_are_the_rows_of_each():
    table, ids = Table.empty({"a": Column("f8", (3,)), "b": Column("i4")}).appended(a=np.random.rand(700, 3), b=np.arange(700))
    for chosen in (ids[::7], ids[::-3], np.array([699, 0, 256, 255, 0]), ids[:0]):
        a, b = table.columns_at(chosen, "a", "b")
        np.testing.assert_array_equal(a, table.column("a")[chosen])
        np.testing.assert_array_equal(b, table.rows("b", chosen))
        np.testing.assert_array_equal(b, chosen)


def test_columns_may_have_no_bytes_and_ids_any_order():
    table, ids = Table.empty({"a": Column("u1", (0,)), "b": Column("?")}).appended(a=np.zeros((700, 0)), b=np.zeros(700))
    chosen = ids[::-7]
    after = table.updated(chosen, a=np.zeros((len(chosen), 0)), b=np.ones(len(chosen)))
    assert after.rows("a", chosen).shape == (100, 0) and np.array_equal(np.flatnonzero(after.column("b")), chosen[::-1])
    assert after.updated(ids[:0], b=np.zeros(0)) is after


def test_freed_chunks_hold_zeros():
    before, _ = Table.empty(SCHEMA).appended(**rows(3 * CHUNK + 7))
    after = before.emptied(np.array([0, 2]))
    assert [after.is_empty(number) for number in range(4)] == [True, False, True, False] and not before.is_empty(0)
    assert after.nbytes == before.nbytes * (CHUNK + 7) / (3 * CHUNK + 7)
    assert after.rows("n", np.array([0, CHUNK, 2 * CHUNK, 3 * CHUNK])).tolist() == [0, CHUNK, 0, 3 * CHUNK]
    longer, ids = after.appended(**rows(CHUNK, 3 * CHUNK + 7))
    assert longer.rows("n", ids).tolist() == ids.tolist() and longer.is_empty(2)
    assert after.emptied(np.array([0])) is after
    again = after.updated(np.array([3]), n=np.array([5]))
    assert not again.is_empty(0) and again.is_empty(2) and after.is_empty(0)
    kept = before.keeping(np.array([[CHUNK - 1, CHUNK + 1], [5, 5]]))  # the last chunk is not full
    assert [kept.is_empty(number) for number in range(4)] == [False, False, True, False]
    assert [before.keeping(np.empty((0, 2), int)).is_empty(number) for number in range(4)] == [True, True, True, False]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_freed_chunks_take_no_memory():
    """Columns of 98 kB, as those of a room: the process has returned as many, and its heap would give them again, cleared."""

    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE

    table, _ = Table.empty(SCHEMA).appended(**rows(16 * CHUNK))
    returned = [np.ones(3 * len(table)) for _ in range(400)]
    returned = returned[::2]  # every other one: what lies between keeps the heap from giving it back to the system
    before = resident()
    versions = [table.emptied(np.arange(15))]
    while len(versions) < 300:
        versions.append(versions[-1].updated(np.array([len(table) - 1]), x=np.ones((1, 3)), n=np.ones(1, np.int32)))
    assert resident() - before < 10e6, "300 versions hold one chunk of sixteen each"
    assert all(version.row("x", 0).tolist() == [0.0, 0.0, 0.0] for version in versions) and len(returned) == 200
