"""Grids of voxels as .npz files: the arrays ``cells`` [nx, ny, nz], ``origin`` [3] and ``cell_size``.

Cells are true or false, or numbers by which regions of other materials choose some, 0 where there is none.

Cells are written and read some rows at a time, so in memory a file takes what its cells do as runs.
"""

from __future__ import annotations

import itertools
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from .cells import Cells, unite
from .errors import EnvironmentFailedError, InputError
from .files import whole_file

# Files name every cell, occupied or not; this many take half a minute.
MAX_CELLS = 2**33
# Bytes of cells that are read at a time.
_CHUNK = 1 << 25


def write_grid(path: Path, cells: Cells, origin: np.ndarray, cell_size: float) -> None:
    """Write a grid, which a body of voxels can use.

    Raises:
        InputError: it has more cells than a file may have.
        EnvironmentFailedError: the file cannot be written.
    """
    if cells.grid_size > MAX_CELLS:
        raise InputError(
            f"{path}: a file holds at most {MAX_CELLS:,} cells, not {' x '.join(map(str, cells.shape))}; lower the "
            "resolution, or use the model itself in a scene"
        )
    try:
        with whole_file(path) as unfinished, zipfile.ZipFile(unfinished, "w", zipfile.ZIP_DEFLATED) as archive:
            with archive.open("cells.npy", "w", force_zip64=True) as file:
                header = {"descr": "|b1", "fortran_order": False, "shape": cells.shape}
                npy.write_array_header_1_0(file, header)
                for rows in cells.rows():
                    file.write(rows.tobytes())
            for name, value in (("origin", origin), ("cell_size", cell_size)):
                with archive.open(f"{name}.npy", "w") as file:
                    npy.write_array(file, np.asarray(value, float))
    except OSError as error:
        raise EnvironmentFailedError(f"{path}: cannot write the grid: {error.strerror or error}") from error


def read_grid(path: Path, value: int | None = None) -> tuple[Cells, np.ndarray | None, float | None]:
    """Read the cells of a grid, and its origin and its cell size where the file has them.

    Args:
        path: the file.
        value: number of the cells that are meant; all that are not 0 if None.

    Raises:
        Exception: whatever reading trips over; all of it means that the file is broken.
    """
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        if "cells.npy" not in names:
            found = ", ".join(name.removesuffix(".npy") for name in names[:5])
            raise ValueError(f"it has no array cells, only {found or 'nothing'}")
        cells = _read_cells(archive, value)
        origin = _read_numbers(archive, "origin", 3) if "origin.npy" in names else None
        cell_size = float(_read_numbers(archive, "cell_size", 1)[0]) if "cell_size.npy" in names else None
    return cells, origin, cell_size


def _read_header(file: Any, name: str, most: int) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, order and type of an array, of which nothing more has been read."""
    version = npy.read_magic(file)
    shape, is_fortran, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(file)
    if dtype.kind not in "biuf":
        raise ValueError(f"{name} must be numbers, not {dtype}")
    if math.prod(shape) > most:
        raise ValueError(f"{name} has {' x '.join(map(str, shape))} numbers; there may be {most:,}")
    return shape, is_fortran, dtype


def _read_numbers(archive: zipfile.ZipFile, name: str, count: int) -> np.ndarray:
    """Return a small array, float64 [count]."""
    with archive.open(f"{name}.npy") as file:
        shape, _, dtype = _read_header(file, name, count)
        if math.prod(shape) != count:
            raise ValueError(f"{name} must have {count} numbers, not {list(shape)}")
        return np.frombuffer(_read(file, count * dtype.itemsize), dtype).astype(float)


def _read_cells(archive: zipfile.ZipFile, value: int | None) -> Cells:
    """Read the cells some planes at a time, of equal x or in Fortran's order of equal z, or some rows of a plane."""
    with archive.open("cells.npy") as file:
        whole, is_fortran, dtype = _read_header(file, "cells", MAX_CELLS)
        if len(whole) != 3 or 0 in whole:
            raise ValueError(f"cells must be [x, y, z], not {list(whole)}")
        nx, ny, nz = whole
        stored = whole[::-1] if is_fortran else whole
        row_size = stored[2] * dtype.itemsize
        depth, width = max(1, _CHUNK // (stored[1] * row_size)), min(max(1, _CHUNK // row_size), stored[1])
        events = []
        for plane, y in itertools.product(range(0, stored[0], depth), range(0, stored[1], width)):
            shape = min(depth, stored[0] - plane), min(width, stored[1] - y), stored[2]
            data = np.frombuffer(_read(file, shape[0] * shape[1] * row_size), dtype)
            if np.isnan(data).any():
                raise ValueError("cells must be numbers; some are NaN")
            block = (data != 0 if value is None else data == value).reshape(shape)
            row, low, high = Cells.of(block.T if is_fortran else block).runs()
            x, along_y = np.divmod(row, shape[1])
            first_x, first_z = (0, plane) if is_fortran else (plane, 0)
            place = ((first_x + x) * ny + y + along_y) * (nz + 1) + first_z
            events += [2 * (place + low) + 1, 2 * (place + high)]
    return unite((nx, ny, nz), np.concatenate(events))


def _read(file: Any, count: int) -> bytes:
    """Return the next bytes of a file, which has to have that many."""
    data: bytes = file.read(count)
    if len(data) < count:
        raise ValueError("it ends too early")
    return data
