"""Mesh -> occupancy grid."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import trimesh
import warp as wp

from warpjelly.kernels import voxels

from .device import start_warp
from .errors import EnvironmentFailedError
from .files import whole_file

# How cells are told to be inside, by the crossings of a ray from their centres: an odd number; a winding number that is
# not 0; the majority of odd numbers along three axes.
METHODS = {
    "parity": "what an odd number of surfaces encloses is inside",
    "winding": "what any surface goes round is inside",
    "vote": "inside is where most of three axes say so",
}
# Planes of bits that count crossings.
PARITY, WINDING = 1, 4
# A grid and a mesh in it are together at most this many cells long; coordinates in subcells are exact up to there.
MAX_CELLS = 5000
# The coarse grid on which a closed mesh is looked at before a method is chosen.
LOOK_RESOLUTION = 64


@dataclass(frozen=True)
class VoxelGrid:
    """A cubic grid around a mesh, and which of its cells are inside."""

    cells: np.ndarray
    """Occupied cells, bool [nx, ny, nz]."""
    origin: np.ndarray
    """Lowest corner, float64 [3], in units of the mesh."""
    cell_size: float
    """Edge of a cell, in units of the mesh."""
    method: str
    """One of METHODS."""
    open_columns: int
    """Columns of cells along z in which the surface is open."""
    thin_triangles: int
    """Triangles that pass through a cell with none inside around it: parts that are too thin for the grid."""

    @property
    def volume(self) -> float:
        """Volume of the occupied cells, in units of the mesh."""
        return int(np.count_nonzero(self.cells)) * self.cell_size**3


def voxelize_mesh(
    mesh: trimesh.Trimesh,
    resolution: int,
    *,
    method: str = "auto",
    keep_thin_parts: bool = False,
    pieces: str = "all",
    device: str = "cpu",
) -> tuple[VoxelGrid, list[str]]:
    """Voxelize a mesh by the method that suits it.

    Args:
        mesh: as from ``load_mesh``.
        resolution: cells along the longest edge, 1 to 4096.
        method: one of METHODS, or "auto".
        keep_thin_parts: as for ``voxelize``.
        pieces: "all", or "largest" for what is joined through faces to most others alone.
        device: where to scan-convert.

    Returns:
        The grid, which may be empty, and what the user should know of mesh and grid, a sentence each.
    """
    triangles = np.asarray(mesh.triangles)
    chosen, faults = choose_method(triangles, closed=bool(mesh.is_watertight), device=device)
    notes = []
    chosen = chosen if method == "auto" else method
    if faults:
        notes.append(f"the mesh {' and '.join(faults)}; method {chosen}: {METHODS[chosen]}")
    grid = voxelize(triangles, resolution, method=chosen, keep_thin_parts=keep_thin_parts, device=device)
    if grid.thin_triangles and grid.cells.any():
        fate = "kept as the cells that they pass through" if keep_thin_parts else "lost; keep_thin_parts keeps them"
        notes.append(
            f"{grid.thin_triangles:,} of {len(triangles):,} triangles have parts with no cell inside near them, "
            f"thinner than a cell: {fate}, and a higher resolution shows them"
        )
    _, sizes = find_pieces(grid.cells)
    if len(sizes) > 1:
        largest = ", ".join(f"{size:,}" for size in sizes[:5]) + (", ..." if len(sizes) > 5 else "")
        fate = (
            "the first alone is kept" if pieces == "largest" else 'each moves by itself; pieces = "largest" keeps one'
        )
        notes.append(f"it has {len(sizes):,} pieces that no face joins, of {largest} voxels: {fate}")
        if pieces == "largest":
            grid = keep_largest_piece(grid)
    return grid, notes


def save_grid(grid: VoxelGrid, path: Path) -> None:
    """Write cells, origin and cell size of a grid to an .npz file, which a body of voxels can use.

    Raises:
        EnvironmentFailedError: the file cannot be written.
    """
    try:
        with whole_file(path) as unfinished:
            np.savez_compressed(unfinished, cells=grid.cells, origin=grid.origin, cell_size=grid.cell_size)
    except OSError as error:
        raise EnvironmentFailedError(f"{path}: cannot write the grid: {error.strerror or error}") from error


def choose_method(triangles: np.ndarray, *, closed: bool, device: str = "cpu") -> tuple[str, list[str]]:
    """Return the method that suits a mesh, and what is wrong with the mesh, in words.

    Args:
        triangles: corners, float [triangle_count, 3, 3].
        closed: whether every edge of the mesh joins two triangles.
        device: where to scan-convert.
    """
    if not closed:
        return "vote", ["is not watertight"]
    grid = _Grid.around(triangles, LOOK_RESOLUTION, device)
    seen = grid.fill(WINDING).seen
    # Modulo 16: 1 to 7 times around, or -8 to -1 times.
    faults = []
    if any(seen[8:]):
        faults.append("is inside out" if not any(seen[1:8]) else "is partly inside out")
    once = [1, 15]
    if any(seen[number] for number in range(1, 16) if number not in once) or all(seen[number] for number in once):
        faults.append("intersects itself")
        return "winding", faults
    return "parity", faults


def voxelize(
    triangles: np.ndarray,
    resolution: int,
    *,
    method: str = "parity",
    keep_thin_parts: bool = False,
    device: str = "cpu",
) -> VoxelGrid:
    """Find the cells of a cubic grid whose centres are inside a mesh.

    The cubic grid is centred on the mesh; its edge is the mesh's largest extent, cut in ``resolution`` cells. Along the
    shorter axes only the cells that meet the mesh's bounding box are kept.

    Args:
        triangles: corners, float [triangle_count, 3, 3], finite, of non-zero extent.
        resolution: cells along the longest edge, 1 to 4096.
        method: one of METHODS. "vote" leaves out rays in whose column the surface is open; where it comes to no result
            the generalised winding number decides.
        keep_thin_parts: occupy the cells, too, that thin parts of the surface pass through.
        device: where to scan-convert.
    """
    return _fill(triangles, _Grid.around(triangles, resolution, device), method, keep_thin_parts)


def voxelize_on_grid(
    mesh: trimesh.Trimesh, grid: VoxelGrid, *, keep_thin_parts: bool = False, device: str = "cpu"
) -> tuple[np.ndarray, list[str]]:
    """Find the cells of a given grid whose centres are inside another mesh, by the method that suits it.

    Args:
        mesh: as from ``load_mesh``, in the frame and units of the grid; together they are at most MAX_CELLS long.
        grid: only its place, shape and cell size count.
        keep_thin_parts: as for ``voxelize``.
        device: where to scan-convert.

    Returns:
        The cells, bool [nx, ny, nz], and what the user should know of the mesh, a sentence each.
    """
    triangles = np.asarray(mesh.triangles)
    method, faults = choose_method(triangles, closed=bool(mesh.is_watertight), device=device)
    given = _Grid(triangles, np.array(grid.cells.shape), grid.origin, grid.cell_size, device)
    notes = [f"the mesh {' and '.join(faults)}; method {method}: {METHODS[method]}"] if faults else []
    return _fill(triangles, given, method, keep_thin_parts).cells, notes


def _fill(triangles: np.ndarray, grid: _Grid, method: str, keep_thin_parts: bool) -> VoxelGrid:
    """Find the cells of a grid that are inside, as ``voxelize`` says."""
    if method == "vote":
        filled = _vote(triangles, grid)
    else:
        filled = grid.fill(PARITY if method == "parity" else WINDING)
    cells = filled.cells.numpy().view(bool)
    thin_count, added = grid.find_thin_parts(filled.cells, keep=keep_thin_parts)
    if keep_thin_parts:
        cells |= added
    return VoxelGrid(
        cells=cells,
        origin=grid.origin,
        cell_size=grid.cell_size,
        method=method,
        # Past its last crossing a column is outside again, unless the mesh is open there.
        open_columns=int(np.count_nonzero(filled.open_columns)),
        thin_triangles=thin_count,
    )


def find_pieces(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the pieces of a grid that are joined through faces.

    Args:
        cells: occupied cells, bool [nx, ny, nz].

    Returns:
        The piece of each run of occupied cells along z in scan order, int [run_count], pieces from 0 by falling size;
        the number of cells of each piece, int [piece_count].
    """
    start_warp()
    nx, ny, _ = cells.shape
    low, high, rows = _find_runs(cells)
    row_start = np.searchsorted(rows, np.arange(nx * ny + 1)).astype(np.int32)
    table = np.empty((nx, ny + 1), np.int32)
    table[:, :-1] = row_start[:-1].reshape(nx, ny)
    table[:, -1] = row_start[ny::ny]
    parent = wp.array(np.arange(len(low)), dtype=wp.int32, device="cpu")
    inputs = [wp.array(part, dtype=wp.int32, device="cpu") for part in (table, low, high)]
    wp.launch(voxels.join_runs, dim=1, inputs=inputs, outputs=[parent], device="cpu")
    _, piece = np.unique(parent.numpy(), return_inverse=True)
    sizes = np.bincount(piece, high - low).astype(np.int64)
    order = np.argsort(-sizes, kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return number[piece], sizes[order]


def keep_largest_piece(grid: VoxelGrid) -> VoxelGrid:
    """Return a grid of the largest of the pieces that are joined through faces alone."""
    pieces, sizes = find_pieces(grid.cells)
    if len(sizes) < 2:
        return grid
    low, high, _ = _find_runs(grid.cells)
    cells = grid.cells.copy()
    # In scan order, occupied cells are the runs one after the other.
    cells[cells] = np.repeat(pieces == 0, high - low)
    return replace(grid, cells=cells)


def _find_runs(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where runs of occupied cells along z begin and end, and in which row nx * ny they are, int [run_count]."""
    nx, ny, nz = cells.shape
    padded = np.zeros((nx * ny, nz + 1), np.int8)
    padded[:, :-1] = cells.reshape(nx * ny, nz)
    change = np.flatnonzero(np.diff(padded.ravel(), prepend=np.int8(0)))
    begin, end = change[::2], change[1::2]
    return begin % (nz + 1), end % (nz + 1), begin // (nz + 1)


@dataclass(frozen=True)
class _Filled:
    """What scan conversion finds."""

    cells: wp.array
    """uint8 [nx, ny, nz], 1 where the winding number is not 0."""
    open_columns: np.ndarray
    """bool [nx, ny]."""
    seen: np.ndarray
    """Whether a winding number was seen, bool [16], modulo 16 or 2."""


class _Grid:
    """A grid, and a mesh in its cells."""

    def __init__(
        self, triangles: np.ndarray, shape: np.ndarray, origin: np.ndarray, cell_size: float, device: str
    ) -> None:
        start_warp()
        self.device = device
        self.shape, self.origin, self.cell_size = shape, origin, cell_size
        self.snapped = np.rint((triangles - origin) * (voxels.SUBCELLS / cell_size)).astype(np.int64)

    @classmethod
    def around(cls, triangles: np.ndarray, resolution: int, device: str) -> Self:
        """Return the grid around a mesh, of so many cells along the longest edge."""
        lower, upper = triangles.min(axis=(0, 1)).astype(float), triangles.max(axis=(0, 1)).astype(float)
        cell_size = float((upper - lower).max()) / resolution
        # The cubic grid less the layers on both sides that the mesh does not reach, as long as there is one left.
        skipped = np.floor((resolution - (upper - lower) / cell_size) / 2 + 1e-9).astype(int)
        shape = resolution - 2 * np.minimum(skipped, (resolution - 1) // 2)
        return cls(triangles, shape, (lower + upper) / 2 - shape * cell_size / 2, cell_size, device)

    def fill(self, planes: int, axis: int = 2) -> _Filled:
        """Count crossings with rays along an axis; cells and columns are those of axes turned until it is z."""
        turned = _turned(axis)
        nx, ny, nz = (int(self.shape[a]) for a in turned)
        snapped = np.ascontiguousarray(self.snapped[:, :, turned])
        with wp.ScopedDevice(self.device):
            bits = wp.zeros((planes, nx, ny, nz // voxels.BITS_PER_WORD + 1), dtype=wp.uint32)
            inputs: list[Any] = [wp.array(snapped, dtype=wp.int64), wp.vec3i(nx, ny, nz)]
            wp.launch(voxels.add_crossings, dim=len(snapped), inputs=inputs, outputs=[bits])
            cells = wp.empty((nx, ny, nz), dtype=wp.uint8)
            open_columns = wp.empty((nx, ny), dtype=wp.uint8)
            seen = wp.zeros(1 << WINDING, dtype=wp.int32)
            wp.launch(voxels.fill_columns, dim=(nx, ny), inputs=[bits], outputs=[cells, open_columns, seen])
        return _Filled(cells, open_columns.numpy() > 0, seen.numpy() > 0)

    def find_thin_parts(self, cells: wp.array, *, keep: bool) -> tuple[int, np.ndarray]:
        """Find parts of the surface with no occupied cell around them.

        Returns:
            The number of triangles that have such a part; where asked to keep them, the cells that these parts pass
            through, with those that join them to the others, bool [nx, ny, nz].
        """
        with wp.ScopedDevice(self.device):
            corners = wp.array(self.snapped / voxels.SUBCELLS, dtype=wp.vec3d)
            thin = wp.zeros(len(corners), dtype=wp.uint8)
            found, joints = (wp.zeros(cells.shape if keep else (0, 0, 0), dtype=wp.uint8) for _ in range(2))
            wp.launch(voxels.find_thin_parts, dim=len(corners), inputs=[corners, cells, True], outputs=[thin, found])
            count = int(np.count_nonzero(thin.numpy()))
            if keep:
                inputs = [corners, found, False]
                wp.launch(voxels.find_thin_parts, dim=len(corners), inputs=inputs, outputs=[thin, joints])
        return count, found.numpy().view(bool) | joints.numpy().view(bool)


def _turned(axis: int) -> list[int]:
    """Return the axes in an order that ends with one of them."""
    return [(axis + 1) % 3, (axis + 2) % 3, axis]


def _vote(triangles: np.ndarray, grid: _Grid) -> _Filled:
    """Let the parities along three axes vote, where the surface is not open; winding numbers break ties."""
    votes = np.zeros(grid.shape, np.int8)
    for axis in range(3):
        filled = grid.fill(PARITY, axis)
        inside = filled.cells.numpy().astype(np.int8)
        counted = (2 * inside - 1) * ~filled.open_columns[:, :, None]
        # Back from the axes as they were turned.
        votes += counted.transpose(np.argsort(_turned(axis)))
    cells = votes > 0
    tied = np.argwhere(votes == 0)
    if len(tied):
        cells[tuple(tied.T)] = _are_inside(triangles, grid, tied)
    return _Filled(wp.array(cells, dtype=wp.uint8, device=grid.device), filled.open_columns, filled.seen)


def _are_inside(triangles: np.ndarray, grid: _Grid, cells: np.ndarray) -> np.ndarray:
    """Say whether the generalised winding number of the centres of cells [count, 3] is at least a half."""
    corners = (triangles - grid.origin) / grid.cell_size
    with wp.ScopedDevice(grid.device):
        mesh = wp.Mesh(
            points=wp.array(corners.reshape(-1, 3), dtype=wp.vec3f),
            indices=wp.array(np.arange(3 * len(corners)), dtype=wp.int32),
            support_winding_number=True,
        )
        inside = wp.empty(len(cells), dtype=wp.uint8)
        centers = wp.array(cells + 0.5, dtype=wp.vec3f)
        wp.launch(voxels.find_windings, dim=len(cells), inputs=[mesh.id, centers], outputs=[inside])
    return inside.numpy() > 0
