"""What the stage shows of a body, prim by prim, and how it hangs on the particles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from warpjelly.kernels.lattices import STRUCTURAL

from .embedding import containing_cells, embed, face_cells
from .lattice import Lattice
from .polygons import area_vectors, unit
from .shading import shared_normals

if TYPE_CHECKING:
    from .meshes import LoadedModel
    from .polygons import MeshPrim
    from .scene import Output

# Names of prims below a body.
SURFACE, SPRINGS, PARTICLES = "surface", "springs", "particles"

# Taubin's smoothing, a step that shrinks and one that swells as much: curvature is evened out, the volume stays
# (A signal processing approach to fair surface design, 1995).
_SHRINK, _SWELL, _SMOOTHINGS = 0.5, -0.53, 20
# Thickness of springs and of particles that are drawn, in typical lengths of the body's springs.
_SPRING_WIDTH, _PARTICLE_WIDTH = 0.06, 0.25
# Thickness of the edges of faces, in edges.
_EDGE_WIDTH = 0.05


def _none() -> np.ndarray:
    return np.zeros(0, np.int32)


@dataclass(frozen=True)
class Shape:
    """A prim: its points are means of particles, so that it moves with them. What stays the same over a run."""

    body: str
    """Name of the body."""
    name: str
    """Its own: SURFACE, made of faces; SPRINGS, curves from one point to the next; or PARTICLES, balls."""
    particles: np.ndarray
    """Particles that each point hangs on, in the body, int32 [point_count, k]."""
    weights: np.ndarray
    """How much of each, adding up to 1, float32 [point_count, k]."""
    counts: np.ndarray = field(default_factory=_none)
    """Corners of each face, int32 [face_count]."""
    corners: np.ndarray = field(default_factory=_none)
    """Point at each corner, counter-clockwise from outside, int32 [corner_count]."""
    corner_normals: np.ndarray | None = None
    """Normal at each corner, int32 [corner_count]; that of its point if None."""
    double_sided: bool = False
    """Whether the faces are seen from both sides."""
    width: float = 0.0
    """Thickness of springs or particles, m."""
    kinds: np.ndarray | None = None
    """Kind of each spring, int [point_count / 2], where colours show it."""
    model: LoadedModel | None = None
    """The model whose polygons these are."""
    prim: str | None = None
    """Path of the mesh of the shot that these are the vertices of, with ``output.over``."""

    @property
    def shows_force(self) -> bool:
        """Whether its colours show forces."""
        return self.kinds is None and self.prim is None

    @property
    def normal_count(self) -> int:
        """Number of normals; 0 without faces."""
        if self.corner_normals is not None:
            return int(self.corner_normals.max()) + 1
        return len(self.particles) if len(self.counts) else 0


@dataclass(frozen=True)
class ShapeFrame:
    """One sample of a shape."""

    points: np.ndarray
    """float32 [point_count, 3], m."""
    normals: np.ndarray
    """float32 [normal_count, 3], unit length."""
    velocities: np.ndarray
    """float32 [point_count, 3], m/s."""
    forces: np.ndarray
    """Magnitude of the total force on each particle, float32 [point_count], N."""


def shapes_of(body: str, lattice: Lattice, output: Output, model: LoadedModel | None = None) -> list[Shape]:
    """Return what the stage shows of a body.

    A body without faces is shown by its springs and particles, whatever is asked for.

    Args:
        body: its name.
        lattice: what it is made of.
        output: what to show.
        model: the model that it was made from, in the frame of the body, where it is to be seen.
    """
    if output.over is not None and model is not None:
        return [_over(body, lattice, prim) for prim in model.prims if len(prim.cage.vertices)]
    faces = len(lattice.surface_quads) > 0
    shown = output.show if faces else [SPRINGS, PARTICLES]
    shapes = []
    if SURFACE in shown:
        shapes.append(_surface(body, lattice, output.surface, model))
    if SPRINGS in shown and lattice.spring_count:
        shapes.append(_springs(body, lattice, by_kind=output.spring_colors == "kind"))
    if PARTICLES in shown:
        everyone = np.arange(len(lattice.particles), dtype=np.int32)
        shapes.append(Shape(body, PARTICLES, *_alone(everyone), width=_PARTICLE_WIDTH * _spring_length(lattice)))
    return shapes


def starts_of(shapes: Sequence[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """Return where points and normals of shapes start, one shape after another, and the ends: int [shape_count + 1]."""
    points = np.cumsum([0, *(len(shape.particles) for shape in shapes)])
    return points, np.cumsum([0, *(shape.normal_count for shape in shapes)])


def face_edges(body: str, lattice: Lattice) -> Shape:
    """Return the edges of the faces of cells on the surface, as the structural springs that they are."""
    quads = lattice.surface_particles[lattice.surface_quads]
    edges = np.unique(np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2), axis=1), axis=0)
    kinds = np.full(len(edges), STRUCTURAL)
    return Shape(body, SPRINGS, *_alone(edges.ravel()), width=_EDGE_WIDTH * lattice.unit, kinds=kinds)


def at_rest(shape: Shape, lattice: Lattice) -> ShapeFrame:
    """Return the sample of a shape in the frame of its body at rest, with no velocities and forces."""
    points = np.einsum("pk,pkc->pc", shape.weights.astype(float), lattice.particles[shape.particles])
    areas = np.repeat(area_vectors(points, shape.counts, shape.corners), shape.counts, axis=0)
    normals = np.zeros((shape.normal_count, 3))
    np.add.at(normals, shape.corners if shape.corner_normals is None else shape.corner_normals, areas)
    return ShapeFrame(
        points=points.astype(np.float32),
        normals=unit(normals).astype(np.float32),
        velocities=np.zeros(points.shape, np.float32),
        forces=np.zeros(len(points), np.float32),
    )


def _alone(particles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Let each point hang on one particle: particles and weights of a shape."""
    return particles[:, None], np.ones((len(particles), 1), np.float32)


def _surface(body: str, lattice: Lattice, surface: str, model: LoadedModel | None) -> Shape:
    if lattice.grid is None:
        hung = _alone(lattice.surface_particles)
        return Shape(body, SURFACE, *hung, *_as_polygons(lattice.surface_quads), double_sided=True)
    if model is not None:
        part = model.drawing
        hung = embed(lattice, part.vertices, containing_cells(lattice, part.vertices))
        polygons = part.counts.astype(np.int32), part.corners.astype(np.int32)
        return Shape(body, SURFACE, *hung, *polygons, corner_normals=shared_normals(part), model=model)
    if surface == "smooth":
        quads = lattice.surface_quads
        points = _smoothed(lattice.particles[lattice.surface_particles], quads)
        hung = embed(lattice, points, _own_cells(lattice, points))
        return Shape(body, SURFACE, *hung, *_as_polygons(quads))
    points, quads = _split_by_direction(lattice)
    return Shape(body, SURFACE, *_alone(lattice.surface_particles[points]), *_as_polygons(quads))


def _over(body: str, lattice: Lattice, prim: MeshPrim) -> Shape:
    """Hang all vertices of a mesh of the shot on the body; it has normals where the mesh has some of its own."""
    cage = prim.cage
    hung = embed(lattice, cage.vertices, containing_cells(lattice, cage.vertices))
    polygons = cage.counts.astype(np.int32), cage.corners.astype(np.int32)
    normals = None if cage.normals is None or not len(cage.corners) else shared_normals(cage)
    return Shape(body, SURFACE, *hung, *polygons, corner_normals=normals, prim=prim.path)


def _as_polygons(quads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.full(len(quads), 4, np.int32), quads.ravel()


def _split_by_direction(lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Split the points of the surface so that faces of different directions share none.

    Returns:
        The point of the lattice's surface for each new one, int32 [point_count]; the faces over the new ones, int32
        [face_count, 4].
    """
    quads = lattice.surface_quads
    outward = area_vectors(lattice.particles[lattice.surface_particles], *_as_polygons(quads))
    axis = np.abs(outward).argmax(axis=1)
    direction = 2 * axis + (np.take_along_axis(outward, axis[:, None], axis=1)[:, 0] > 0)
    points, split, count = [], np.empty_like(quads), 0
    for number in range(6):
        own = direction == number
        used = np.zeros(len(lattice.surface_particles), bool)
        used[quads[own]] = True
        split[own] = (np.cumsum(used, dtype=np.int32) + np.int32(count - 1))[quads[own]]
        points.append(np.flatnonzero(used))
        count += len(points[-1])
    return np.concatenate(points), split


def _smoothed(points: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Return the points [point_count, 3] of a closed surface without its steps, by Taubin's smoothing."""
    start, end = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    degree = np.bincount(start, minlength=len(points))[:, None]
    for share in (_SHRINK, _SWELL) * _SMOOTHINGS:
        # On a closed surface each edge runs once in both directions, so that each neighbour counts once.
        around = np.stack([np.bincount(start, points[end, axis], len(points)) for axis in range(3)], axis=1)
        points = points + share * (around / degree - points)
    return points


def _own_cells(lattice: Lattice, points: np.ndarray) -> np.ndarray:
    """Return for each point of the surface, moved, the nearest of the unit cells whose faces it belongs to.

    Not the nearest of all: those that only touch here move apart.
    """
    cells = np.repeat(face_cells(lattice), 4, axis=0)
    point = lattice.surface_quads.ravel()
    local = lattice.grid_coordinates(points)[point] - cells
    away = np.linalg.norm(local - np.clip(local, 0.0, 1.0), axis=1)
    # The nearest is written last.
    order = np.argsort(-away, kind="stable")
    own = np.empty((len(points), 3), np.int32)
    own[point[order]] = cells[order]
    return own


def _springs(body: str, lattice: Lattice, *, by_kind: bool) -> Shape:
    ends, classes = lattice.springs()
    width = _SPRING_WIDTH * _spring_length(lattice)
    kinds = lattice.classes.kinds[classes] if by_kind else None
    return Shape(body, SPRINGS, *_alone(ends.ravel()), width=width, kinds=kinds)


def _spring_length(lattice: Lattice) -> float:
    """Return the median rest length of the springs, m; without springs, the unit of the lattice."""
    if not lattice.spring_count:
        return lattice.unit
    lengths = lattice.classes.rest_lengths
    count = np.bincount(lattice.spans[:, 3], lattice.spans[:, 2], minlength=len(lengths))
    order = np.argsort(lengths)
    return float(lengths[order][np.searchsorted(np.cumsum(count[order]), count.sum() / 2)])
