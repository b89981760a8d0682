"""Hang points on the cells of a lattice: each becomes a mean of the eight particles at the corners of one cell."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpjelly.kernels import embedding

from .lattice import Lattice
from .polygons import area_vectors


def containing_cells(lattice: Lattice, points: np.ndarray) -> np.ndarray:
    """Return the occupied unit cell that holds each point, or else the nearest one, int32 [point_count, 3].

    Args:
        lattice: made of cells.
        points: in the frame of the body at rest, float64 [point_count, 3], m.
    """
    quads = lattice.surface_quads
    triangles = quads[:, [0, 1, 2, 0, 2, 3]].ravel()
    corners = lattice.grid_coordinates(lattice.positions(lattice.surface_particles))
    faces = wp.Mesh(
        points=wp.array(corners, dtype=wp.vec3f, device="cpu"), indices=wp.array(triangles, wp.int32, device="cpu")
    )
    local = lattice.grid_coordinates(points)
    reach = float(np.linalg.norm(np.ptp(np.concatenate([local, corners]), axis=0)))
    cells = wp.empty(len(points), dtype=wp.vec3i, device="cpu")
    wp.launch(
        embedding.find_cells,
        dim=len(points),
        inputs=[
            lattice.grid,
            faces.id,
            wp.array(face_cells(lattice), dtype=wp.vec3i, device="cpu"),
            wp.array(local, dtype=wp.vec3d, device="cpu"),
            reach,
        ],
        outputs=[cells],
        device="cpu",
    )
    return cells.numpy()


def face_cells(lattice: Lattice) -> np.ndarray:
    """Return the unit cell behind each face of the surface, int32 [face_count, 3]."""
    points, quads = lattice.grid_coordinates(lattice.positions(lattice.surface_particles)), lattice.surface_quads
    # Half a cell behind the middle of the face is the centre of the cell; area vectors here are two cells long.
    outward = area_vectors(points, np.full(len(quads), 4), quads.ravel())
    return np.floor(points[quads].mean(axis=1) - outward / 4).astype(np.int32)


def embed(lattice: Lattice, points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the particles that points hang on, int32 [point_count, 8], and their weights, float32.

    Args:
        lattice: made of cells.
        points: in the frame of the body at rest, float64 [point_count, 3], m.
        cells: an occupied unit cell for each, which need not hold it, int32 [point_count, 3].
    """
    particles = wp.empty((len(points), 8), dtype=wp.int32, device="cpu")
    weights = wp.empty((len(points), 8), dtype=wp.float32, device="cpu")
    wp.launch(
        embedding.embed_points,
        dim=len(points),
        inputs=[
            lattice.grid,
            wp.array(lattice.grid_coordinates(points), dtype=wp.vec3d, device="cpu"),
            wp.array(cells, dtype=wp.vec3i, device="cpu"),
        ],
        outputs=[particles, weights],
        device="cpu",
    )
    return particles.numpy(), weights.numpy()
