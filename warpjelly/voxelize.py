"""Mesh -> occupancy grid."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import trimesh
import warp as wp

from warpjelly.kernels import voxels

from .cells import Cells, add_up, is_last, unite
from .device import start_warp
from .errors import SceneError

# How cells are told to be inside, by the crossings of a ray from their centres: an odd number; a winding number that is
# not 0; the majority of odd numbers along three axes.
METHODS = {
    "parity": "what an odd number of surfaces encloses is inside",
    "winding": "what any surface goes round is inside",
    "vote": "inside is where most of three axes say so",
}
# A grid and a mesh in it are together at most this many cells long; coordinates in subcells are exact up to there.
MAX_CELLS = 5000
# Cells that may be told one by one, by winding numbers: some ten seconds and a gigabyte.
MAX_TIES = 1 << 24
# The coarse grid on which a closed mesh is looked at before a method is chosen.
LOOK_RESOLUTION = 64


@dataclass(frozen=True)
class VoxelGrid:
    """A cubic grid around a mesh, and which of its cells are inside."""

    cells: Cells
    """Occupied cells."""
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
    piece_sizes: np.ndarray
    """Number of cells of each piece that is joined through faces, falling, int64 [piece_count]."""

    @property
    def volume(self) -> float:
        """Volume of the occupied cells, in units of the mesh."""
        return self.cells.count * self.cell_size**3


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
    chosen, faults = choose_method(mesh, device=device)
    notes = []
    chosen = chosen if method == "auto" else method
    grid = voxelize(triangles, resolution, method=chosen, keep_thin_parts=keep_thin_parts, device=device)
    if faults:
        note = f"the mesh {' and '.join(faults)}; method {chosen}: {METHODS[chosen]}"
        if grid.open_columns:
            note += f"; seen along z it is open in {grid.open_columns:,} of {math.prod(grid.cells.shape[:2]):,} columns"
        notes.append(note)
    if grid.thin_triangles and grid.cells.count:
        fate = "kept as the cells that they pass through" if keep_thin_parts else "lost; keep_thin_parts keeps them"
        notes.append(
            f"{grid.thin_triangles:,} of {len(triangles):,} triangles have parts with no cell inside near them, "
            f"thinner than a cell: {fate}, and a higher resolution shows them"
        )
    sizes = grid.piece_sizes
    if len(sizes) > 1:
        largest = ", ".join(f"{size:,}" for size in sizes[:5]) + (", ..." if len(sizes) > 5 else "")
        fate = (
            "the first alone is kept" if pieces == "largest" else 'each moves by itself; pieces = "largest" keeps one'
        )
        notes.append(f"it has {len(sizes):,} pieces that no face joins, of {largest} voxels: {fate}")
        if pieces == "largest":
            grid = keep_largest_piece(grid)
    return grid, notes


def is_closed(mesh: trimesh.Trimesh) -> bool:
    """Say whether a surface has no border: an even number of triangles meets at every edge.

    Four do where solids touch, whose surfaces are as closed as before.
    """
    return bool(mesh.is_watertight) or not (_edge_counts(mesh)[0] % 2).any()


def _edge_counts(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Return how many triangles each edge has, and how many more run along it in one direction than in the other."""
    ends = np.asarray(mesh.faces, np.int64)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    # A triangle of two equal corners is no more than an edge there and back.
    ends = ends[ends[:, 0] != ends[:, 1]]
    _, edge = np.unique(ends.min(axis=1) * len(mesh.vertices) + ends.max(axis=1), return_inverse=True)
    return np.bincount(edge), np.bincount(edge, np.where(ends[:, 0] < ends[:, 1], 1, -1))


def choose_method(mesh: trimesh.Trimesh, *, device: str = "cpu") -> tuple[str, list[str]]:
    """Return the method that suits a mesh, and what is wrong with the mesh, in words.

    Args:
        mesh: as from ``load_mesh``.
        device: where to scan-convert.
    """
    if not is_closed(mesh):
        return "vote", ["is not watertight"]
    if not (mesh.is_watertight and mesh.is_winding_consistent) and _edge_counts(mesh)[1].any():
        # Windings mean nothing then.
        return "parity", ["has triangles that are turned over"]
    least, most = _Grid.around(np.asarray(mesh.triangles), LOOK_RESOLUTION, device).fill().windings
    faults = []
    if least < 0:
        faults.append("is inside out" if most == 0 else "is partly inside out")
    if most - least > 1:
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

    Raises:
        SceneError: holes leave too much to winding numbers.
    """
    return _fill(triangles, _Grid.around(triangles, resolution, device), method, keep_thin_parts)


def voxelize_on_grid(
    mesh: trimesh.Trimesh, grid: VoxelGrid, *, keep_thin_parts: bool = False, device: str = "cpu"
) -> tuple[Cells, list[str]]:
    """Find the cells of a given grid whose centres are inside another mesh, by the method that suits it.

    Args:
        mesh: as from ``load_mesh``, in the frame and units of the grid; together they are at most MAX_CELLS long.
        grid: only its place, shape and cell size count.
        keep_thin_parts: as for ``voxelize``.
        device: where to scan-convert.

    Returns:
        The cells, and what the user should know of the mesh, a sentence each.

    Raises:
        SceneError: holes leave too much to winding numbers.
    """
    triangles = np.asarray(mesh.triangles)
    method, faults = choose_method(mesh, device=device)
    given = _Grid(triangles, grid.cells.shape, grid.origin, grid.cell_size, device)
    notes = [f"the mesh {' and '.join(faults)}; method {method}: {METHODS[method]}"] if faults else []
    return _fill(triangles, given, method, keep_thin_parts).cells, notes


def _fill(triangles: np.ndarray, grid: _Grid, method: str, keep_thin_parts: bool) -> VoxelGrid:
    """Find the cells of a grid that are inside, as ``voxelize`` says."""
    filled = _vote(triangles, grid) if method == "vote" else grid.fill(parity=method == "parity")
    thin_count, thin = grid.find_thin_parts(filled.cells, keep=keep_thin_parts)
    cells = filled.cells.joined(thin)
    return VoxelGrid(
        cells=cells,
        origin=grid.origin,
        cell_size=grid.cell_size,
        method=method,
        open_columns=filled.open_rows.run_count,
        thin_triangles=thin_count,
        piece_sizes=find_pieces(cells)[1],
    )


def find_pieces(cells: Cells) -> tuple[np.ndarray, np.ndarray]:
    """Find the pieces of a grid that are joined through faces.

    Returns:
        The piece of each run of occupied cells, int [run_count], pieces from 0 by falling size; the number of cells of
        each piece, int [piece_count].
    """
    start_warp()
    parent = wp.array(np.arange(cells.run_count), dtype=wp.int32, device="cpu")
    wp.launch(voxels.join_runs, dim=1, inputs=[_runs(cells, "cpu")], outputs=[parent], device="cpu")
    _, piece = np.unique(parent.numpy(), return_inverse=True)
    sizes = np.bincount(piece, cells.edges[1::2] - cells.edges[::2]).astype(np.int64)
    order = np.argsort(-sizes, kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return number[piece], sizes[order]


def keep_largest_piece(grid: VoxelGrid) -> VoxelGrid:
    """Return a grid of the largest of the pieces that are joined through faces alone."""
    piece, sizes = find_pieces(grid.cells)
    return replace(grid, cells=grid.cells.kept(piece == 0), piece_sizes=sizes[:1])


def _runs(cells: Cells, device: str) -> voxels.Runs:
    """Return cells as the kernels take them."""
    runs = voxels.Runs()
    runs.shape = wp.vec3i(*cells.shape)
    _, *ends = cells.runs()
    runs.row_start, runs.low, runs.high = (
        wp.array(part, dtype=wp.int32, device=device) for part in (cells.row_start(), *ends)
    )
    return runs


@dataclass(frozen=True)
class _Filled:
    """What scan conversion finds."""

    cells: Cells
    open_rows: Cells
    """Rows in which the surface is open: all of their cells, or none."""
    windings: tuple[int, int]
    """The least and the greatest winding number of a cell."""


class _Grid:
    """A grid, and a mesh in its cells."""

    def __init__(
        self, triangles: np.ndarray, shape: tuple[int, int, int], origin: np.ndarray, cell_size: float, device: str
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
        nx, ny, nz = (resolution - 2 * np.minimum(skipped, (resolution - 1) // 2)).tolist()
        origin = (lower + upper) / 2 - np.array((nx, ny, nz)) * cell_size / 2
        return cls(triangles, (nx, ny, nz), origin, cell_size, device)

    def fill(self, axis: int = 2, *, parity: bool = False) -> _Filled:
        """Count crossings with rays along an axis; cells are those of axes turned until it is z.

        Cells are filled where the surface goes round them, or, with parity, where it does an odd number of times.
        """
        turned = [(axis + 1) % 3, (axis + 2) % 3, axis]
        shape = (self.shape[turned[0]], self.shape[turned[1]], self.shape[turned[2]])
        triangles = wp.array(np.ascontiguousarray(self.snapped[:, :, turned]), dtype=wp.int64, device=self.device)
        crossings, _ = self._collect(voxels.find_crossings, [triangles, wp.vec3i(*shape)])
        places, windings = add_up(crossings)
        rows, heights = np.divmod(places, shape[2] + 1)
        ends = np.flatnonzero(is_last(rows))
        # What is left over in a row does not count in the next one.
        left = windings[ends]
        if left.any():
            windings -= np.repeat(np.append(0, left[:-1]), np.diff(ends, prepend=-1))
        inside = windings % 2 == 1 if parity else windings != 0
        is_open = rows[ends[inside[ends]]]
        # Past the last cell there is nothing, also where the surface is open.
        inside &= heights < shape[2]
        open_rows = Cells(shape, (is_open[:, None] * (shape[2] + 1) + [0, shape[2]]).ravel())
        places = np.append(places, open_rows.edges[1::2])
        order = np.argsort(places, kind="stable")
        cells = Cells.between(shape, places[order], np.append(inside, np.zeros(len(is_open), bool))[order])
        return _Filled(cells, open_rows, (int(windings.min(initial=0)), int(windings.max(initial=0))))

    def find_thin_parts(self, cells: Cells, *, keep: bool) -> tuple[int, Cells]:
        """Find parts of the surface with no occupied cell around them.

        Returns:
            The number of triangles that have such a part; where asked to keep them, the cells that these parts pass
            through, with those that join them to the others, otherwise none.
        """
        triangles = wp.array(self.snapped, dtype=wp.int64, device=self.device)
        everyone = wp.ones(len(triangles), dtype=wp.int64, device=self.device)
        inputs = [triangles, _runs(cells, self.device), True, everyone]
        places, thin = self._collect(voxels.find_thin_parts, inputs)
        found = _occupy(cells.shape, places if keep else places[:0])
        if found.count:
            joints, _ = self._collect(voxels.find_thin_parts, [triangles, _runs(found, self.device), False, thin])
            found = _occupy(cells.shape, np.concatenate([places, joints]))
        return int(np.count_nonzero(thin.numpy())), found

    def _collect(self, kernel: wp.Kernel, inputs: list[Any]) -> tuple[np.ndarray, wp.array]:
        """Return what a kernel finds of all triangles, int64 [count], and how much of each triangle, on the device."""
        with wp.ScopedDevice(self.device):
            starts, counts = (wp.zeros(len(self.snapped), dtype=wp.int64) for _ in range(2))
            none = wp.empty(0, dtype=wp.int64)
            wp.launch(kernel, dim=len(counts), inputs=[*inputs, starts], outputs=[none, counts])
            total = np.cumsum(counts.numpy())
            starts.assign(total - counts.numpy())
            found = wp.empty(int(total[-1]), dtype=wp.int64)
            if len(found):
                wp.launch(kernel, dim=len(counts), inputs=[*inputs, starts], outputs=[found, counts])
            return found.numpy(), counts


def _occupy(shape: tuple[int, int, int], places: np.ndarray) -> Cells:
    """Return the cells at some places, any number of times each."""
    return unite(shape, np.concatenate([2 * places + 1, 2 * places + 2]))


def _vote(triangles: np.ndarray, grid: _Grid) -> _Filled:
    """Let the parities along three axes vote, where the surface is not open; winding numbers break ties."""
    ballots = []
    for axis in range(3):
        filled = grid.fill(axis, parity=True)
        counted = filled.cells.kept(~np.isin(filled.cells.runs()[0], filled.open_rows.runs()[0]))
        # Two for a cell inside and one for any cell of an open row: three are a tie.
        for part in (counted, counted, filled.open_rows):
            # Back from the axes as they were turned.
            for _ in range((axis + 1) % 3):
                part = part.turned()
            ballots.append(part.events())
    places, votes = add_up(np.concatenate(ballots))
    cells = Cells.between(grid.shape, places, votes > 3)
    ties = Cells.between(grid.shape, places, votes == 3)
    if ties.count > MAX_TIES:
        raise SceneError(
            f"as seen along all three axes the mesh is open around {ties.count:,} cells, more than {MAX_TIES:,}: close "
            "it, lower the resolution, or choose another method"
        )
    if ties.count:
        tied = ties.places()
        won = _occupy(grid.shape, tied[_are_inside(triangles, grid, tied)])
        cells = cells.joined(won)
    return _Filled(cells, filled.open_rows, filled.windings)


def _are_inside(triangles: np.ndarray, grid: _Grid, places: np.ndarray) -> np.ndarray:
    """Say whether the generalised winding number of the centres of cells at places is at least a half."""
    corners = (triangles - grid.origin) / grid.cell_size
    _, ny, nz = grid.shape
    row, z = np.divmod(places, nz + 1)
    with wp.ScopedDevice(grid.device):
        mesh = wp.Mesh(
            points=wp.array(corners.reshape(-1, 3), dtype=wp.vec3f),
            indices=wp.array(np.arange(3 * len(corners)), dtype=wp.int32),
            support_winding_number=True,
        )
        inside = wp.empty(len(places), dtype=wp.uint8)
        centers = wp.array(np.stack([row // ny, row % ny, z], axis=1) + 0.5, dtype=wp.vec3f)
        wp.launch(voxels.find_windings, dim=len(places), inputs=[mesh.id, centers], outputs=[inside])
    return inside.numpy() > 0
