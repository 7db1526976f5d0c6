"""Rows compared, taken and turned by their addresses, beside NumPy."""

import numpy as np
import pytest

from trihedron.pipeline.core.table import CHUNK, Column, Table
from trihedron.pipeline.record.row_kernels import differing, take, turn

KINDS = [Column("?"), Column("u1", (3,)), Column("i2"), Column("f4", (3,)), Column("f8", (2, 3)), Column("u1", (32,))]


def table_of(column, rng, size):
    values = rng.integers(0, 2, (size, *column.shape)).astype(column.dtype)
    return Table.empty({"x": column}).appended(x=values)[0], values


@pytest.mark.parametrize("column", KINDS, ids=[f"{column.dtype}{column.shape}" for column in KINDS])
def test_rows_that_changed_or_are_new_are_found_and_taken_either_way(column):
    rng = np.random.default_rng(3)
    before, old = table_of(column, rng, CHUNK + 90)
    changed = np.sort(rng.choice(before.size, 40, replace=False)).astype(np.int32)
    after = before.updated(changed, x=np.zeros((40, *column.shape), column.dtype))
    after, _ = after.appended(x=np.ones((CHUNK, *column.shape), column.dtype))
    now = after.column("x")
    found = np.empty(3 * CHUNK, np.int32)
    chunks = np.arange(3, dtype=np.int32)
    count = differing(before.addresses("x"), after.addresses("x"), chunks, CHUNK, before.size, after.size, column.row_bytes, found)
    apart = (now[: before.size] != old).reshape(before.size, -1).any(axis=1)
    assert found[:count].tolist() == [*np.flatnonzero(apart), *range(before.size, after.size)]
    rows = found[:count]
    expected = np.ascontiguousarray(now[rows]).view(np.uint8).reshape(count, -1)
    for turned, bytes in ((False, expected), (True, expected.T)):
        out = np.empty(expected.size, np.uint8)
        take(after.addresses("x"), rows, CHUNK, column.row_bytes, turned, out)
        np.testing.assert_array_equal(out, bytes.ravel())
    turn(expected.__array_interface__["data"][0], count, column.row_bytes, out)
    np.testing.assert_array_equal(out, expected.T.ravel())


def test_only_the_chunks_asked_for_are_looked_at_and_nan_is_no_change():
    rows = np.full((2 * CHUNK, 1), np.nan)
    before, _ = Table.empty({"x": Column("f8", (1,))}).appended(x=rows)
    after = before.updated(np.array([3, CHUNK + 5]), x=np.zeros((2, 1)))
    found = np.empty(2 * CHUNK, np.int32)
    for chunks, expected in (([0], [3]), ([1], [CHUNK + 5]), ([0, 1], [3, CHUNK + 5]), ([], [])):
        numbers = np.array(chunks, np.int32)
        count = differing(before.addresses("x"), after.addresses("x"), numbers, CHUNK, before.size, after.size, 8, found)
        assert found[:count].tolist() == expected


def test_addresses_known_of_the_version_before_are_those_of_the_chunks():
    before, _ = Table.empty({"x": Column("f8")}).appended(x=np.zeros(3 * CHUNK))
    before.addresses("x")
    chunks = before.chunks["x"]
    later = Table(before.schema, before.size, {"x": (chunks[0], chunks[1].copy(), chunks[2])})
    expected = [later.schema["x"].address_of(chunk) for chunk in later.chunks["x"]]
    assert later.addresses("x", before, [1]).tolist() == expected
    assert before.addresses("x").tolist() != expected
