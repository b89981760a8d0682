"""Read the triangles of a mesh file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from .errors import SceneError

# What trimesh reads with nothing else installed.
EXTENSIONS = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf")


def load_mesh(path: Path) -> trimesh.Trimesh:
    """Read all triangles of a mesh file as one mesh, in the units and axes of the file.

    Raises:
        SceneError: the file has an unknown extension, cannot be read, or holds no triangles of finite size.
    """
    if path.suffix.lower() not in EXTENSIONS:
        raise SceneError(f"{path}: unknown mesh format '{path.suffix}'; known: {' '.join(EXTENSIONS)}")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except OSError as error:
        raise SceneError(f"{path}: cannot read the mesh: {error.strerror or error}") from error
    # The readers raise whatever their parsing happens to trip over; all of it means that the file is broken.
    except Exception as error:
        raise SceneError(f"{path}: not a sound {path.suffix} file: {error or type(error).__name__}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise SceneError(f"{path}: the mesh has no triangles")
    used = mesh.vertices[mesh.faces]
    if not np.isfinite(used).all():
        raise SceneError(f"{path}: the mesh has coordinates that are not finite numbers")
    if not np.ptp(used.reshape(-1, 3), axis=0).max() > 0:
        raise SceneError(f"{path}: the mesh has no size; all its vertices coincide")
    # Formats that repeat the vertices of every triangle would never be watertight otherwise. They repeat them exactly.
    vertices, number = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return trimesh.Trimesh(vertices, number.reshape(-1)[mesh.faces], process=False)
