"""Mesh -> occupancy grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpjelly.kernels import voxels

from .device import start_warp


@dataclass(frozen=True)
class VoxelGrid:
    """A cubic grid around a mesh, and which of its cells are inside."""

    cells: np.ndarray
    """Occupied cells, bool [nx, ny, nz]."""
    origin: np.ndarray
    """Lowest corner, float64 [3], in units of the mesh."""
    cell_size: float
    """Edge of a cell, in units of the mesh."""
    open_columns: int
    """Columns of cells that cross the surface an odd number of times; not zero where the mesh has a hole."""


def voxelize(triangles: np.ndarray, resolution: int, *, device: str = "cpu") -> VoxelGrid:
    """Find the cells of a cubic grid whose centres are inside a closed mesh, by the parity of surface crossings.

    The cubic grid is centred on the mesh; its edge is the mesh's largest extent, cut in ``resolution`` cells. Along the
    shorter axes only the cells that meet the mesh's bounding box are kept.

    Args:
        triangles: corners, float [triangle_count, 3, 3], finite, of non-zero extent.
        resolution: cells along the longest edge, 1 to 4096.
        device: where to scan-convert.
    """
    start_warp()
    lower, upper = triangles.min(axis=(0, 1)).astype(float), triangles.max(axis=(0, 1)).astype(float)
    cell_size = float((upper - lower).max()) / resolution
    # The cubic grid less the layers on both sides that the mesh does not reach.
    skipped = np.floor((resolution - (upper - lower) / cell_size) / 2 + 1e-9).astype(int)
    shape = resolution - 2 * skipped
    origin = (lower + upper) / 2 - shape * cell_size / 2

    snapped = np.rint((triangles - origin) * (voxels.SUBCELLS / cell_size)).astype(np.int64)
    nx, ny, nz = (int(n) for n in shape)
    bits = wp.zeros((ny, nz, nx // 32 + 1), dtype=wp.uint32, device=device)
    wp.launch(
        voxels.toggle_crossings,
        dim=len(snapped),
        inputs=[wp.array(snapped, dtype=wp.int64, device=device), wp.vec3i(nx, ny, nz)],
        outputs=[bits],
        device=device,
    )
    toggles = np.unpackbits(bits.numpy().view(np.uint8), axis=2, bitorder="little")[:, :, : nx + 1]
    inside = np.bitwise_xor.accumulate(toggles, axis=2).astype(bool)
    return VoxelGrid(
        cells=np.ascontiguousarray(inside[:, :, :nx].transpose(2, 0, 1)),
        origin=origin,
        cell_size=cell_size,
        # Past its last crossing a column is outside again, unless the mesh is open there.
        open_columns=int(np.count_nonzero(inside[:, :, nx])),
    )
