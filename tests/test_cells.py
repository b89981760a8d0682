"""Occupied cells as runs against dense arrays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from warpjelly import cells as cells_module
from warpjelly import gridfile
from warpjelly.cells import Cells, add_up, unite
from warpjelly.gridfile import read_grid, write_grid

SHAPES = st.tuples(*[st.integers(1, 5)] * 3)
GRIDS = arrays.arrays(bool, SHAPES)
drawn = settings(max_examples=80, deadline=None, derandomize=True, database=None)


@drawn
@given(dense=GRIDS)
def test_cells_come_back(dense: np.ndarray) -> None:
    """Make runs of a dense grid and the grid of the runs, and count the same in both."""
    cells = Cells.of(dense)
    np.testing.assert_array_equal(cells.dense(), dense)
    assert (cells.shape, cells.grid_size, cells.count) == (dense.shape, dense.size, np.count_nonzero(dense))
    # A run begins where a cell is occupied and the one below is not.
    begins = np.argwhere(dense & ~np.pad(dense, [(0, 0), (0, 0), (1, 0)])[:, :, :-1])
    row, low, high = cells.runs()
    np.testing.assert_array_equal(np.stack([row // dense.shape[1], row % dense.shape[1], low], axis=1), begins)
    assert len(row) == cells.run_count
    assert all(dense[x, y, low:high].all() for (x, y, low), high in zip(begins, high, strict=True))
    np.testing.assert_array_equal(np.diff(cells.row_start()), np.bincount(row, minlength=len(dense) * dense.shape[1]))


@drawn
@given(dense=GRIDS, parts=st.integers(1, 3))
def test_cells_are_turned_and_refined_like_arrays(dense: np.ndarray, parts: int) -> None:
    """Turn the axes of cells, and cut cells into smaller ones."""
    cells = Cells.of(dense)
    np.testing.assert_array_equal(cells.turned().dense(), dense.transpose(2, 0, 1))
    np.testing.assert_array_equal(cells.refined(parts).dense(), np.kron(dense, np.ones([parts] * 3, bool)).astype(bool))
    x, y, z = np.nonzero(dense)
    np.testing.assert_array_equal(cells.places(), (x * dense.shape[1] + y) * (dense.shape[2] + 1) + z)


@drawn
@given(dense=GRIDS, data=st.data())
def test_cells_are_looked_up_from_another_grid(dense: np.ndarray, data: st.DataObject) -> None:
    """Look up layers that are repeated, left out or beyond the grid."""
    layers = [np.sort(data.draw(st.lists(st.integers(-2, n + 1), min_size=1, max_size=7))) for n in dense.shape]
    around = np.pad(dense, 2)
    expected = around[np.ix_(*(numbers + 2 for numbers in layers))]
    np.testing.assert_array_equal(Cells.of(dense).sampled(layers).dense(), expected)


@drawn
@given(shape=SHAPES, data=st.data())
def test_cells_are_combined_by_counting(shape: tuple[int, int, int], data: st.DataObject) -> None:
    """Unite cells, find those that some have in common, and take some away."""
    dense = [data.draw(arrays.arrays(bool, shape)) for _ in range(3)]
    one, other, _ = parts = [Cells.of(part) for part in dense]
    np.testing.assert_array_equal(one.joined(other).dense(), dense[0] | dense[1])
    np.testing.assert_array_equal(one.within(other).dense(), dense[0] & dense[1])
    np.testing.assert_array_equal(one.without(other).dense(), dense[0] & ~dense[1])
    events = np.concatenate([part.events() for part in parts])
    np.testing.assert_array_equal(unite(shape, events).dense(), dense[0] | dense[1] | dense[2])
    places, sums = add_up(events)
    np.testing.assert_array_equal(Cells.between(shape, places, sums > 1).dense(), np.sum(dense, axis=0) > 1)


@drawn
@given(dense=GRIDS, data=st.data())
def test_some_runs_are_kept(dense: np.ndarray, data: st.DataObject) -> None:
    """Keep some runs whole and nothing of the others."""
    cells = Cells.of(dense)
    chosen = data.draw(arrays.arrays(bool, cells.run_count))
    kept = cells.kept(chosen)
    row, low, high = (part[chosen] for part in cells.runs())
    expected = np.zeros_like(dense)
    for number, start, stop in zip(row, low, high, strict=True):
        expected[number // dense.shape[1], number % dense.shape[1], start:stop] = True
    np.testing.assert_array_equal(kept.dense(), expected)


@pytest.mark.parametrize("at_once", [1, 20, 1 << 25])
def test_grid_files_are_numpy_files(tmp_path, monkeypatch, at_once: int) -> None:
    """Write what NumPy reads and read what NumPy writes, in any order and type of numbers, few rows at a time."""
    monkeypatch.setattr(cells_module, "_CHUNK", at_once)
    monkeypatch.setattr(gridfile, "_CHUNK", at_once)
    rng = np.random.default_rng(0)
    path = tmp_path / "grid.npz"
    for dtype in (bool, np.uint8, np.int64, np.float32, ">f8"):
        dense = rng.random(rng.integers(1, 7, 3)) < 0.5
        write_grid(path, Cells.of(dense), np.array([1.0, 2.0, 3.0]), 0.5)
        with np.load(path) as data:
            np.testing.assert_array_equal(data["cells"], dense)
            assert (data["cells"].dtype, data["origin"].tolist(), data["cell_size"]) == (bool, [1.0, 2.0, 3.0], 0.5)
        for order in (np.ascontiguousarray, np.asfortranarray):
            np.savez_compressed(path, cells=order(dense.astype(dtype)), origin=np.arange(3), cell_size=np.float32(0.25))
            cells, origin, cell_size = read_grid(path)
            np.testing.assert_array_equal(cells.dense(), dense)
            assert (origin.tolist(), cell_size) == ([0.0, 1.0, 2.0], 0.25)
        np.savez(path, cells=dense)
        assert read_grid(path)[1:] == (None, None)
    numbers = np.asfortranarray(rng.integers(0, 3, (3, 4, 5)))
    np.savez(path, cells=numbers)
    np.testing.assert_array_equal(read_grid(path, 2)[0].dense(), numbers == 2)
    assert not read_grid(path, 300)[0].count
