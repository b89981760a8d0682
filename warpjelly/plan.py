"""What a scene will take, before it is built: how every body is made, counts and memory."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from warpjelly.kernels.lattices import MAX_MATERIALS

from .cells import Cells
from .errors import SceneError, listed
from .lattice import Lattice, build_lattice, count_lattice
from .machine import memory_limit
from .memory import (
    BYTES_PER_BUILT_PARTICLE,
    BYTES_PER_BUILT_SPAN,
    BYTES_PER_CROSSING,
    BYTES_PER_NUMBER,
    BYTES_PER_ROW,
    BYTES_PER_SAMPLE,
    MAX_ROW_BYTES,
    PROGRAM_BYTES,
    body_bytes,
    peak_bytes,
)
from .network import build_cloth, build_network
from .scene import (
    MAX_LENGTH,
    MIN_LENGTH,
    AnyBody,
    ClothBody,
    CubeBody,
    ModelBody,
    ModelRegion,
    NetworkBody,
    Scene,
    VoxelsBody,
)
from .shapes import PARTICLES, SPRINGS, SURFACE

if TYPE_CHECKING:
    import trimesh

    from .meshes import LoadedModel
    from .shot import Shot
    from .voxelize import VoxelGrid

log = logging.getLogger("warpjelly")
# What takes long on a large model says so here.
steps = logging.getLogger("warpjelly.steps")

# With law "young" springs near the surface differ, so there are so many spans more per face of a jelly cube.
YOUNG_SPANS = 2
# Springs across the boundary of two materials end spans, too: so many times the spans where a body has several.
MIXED_SPANS = 1.5
# Keys of a body that say where it is and what happens to it, not what it is made of.
PLACEMENT = {
    *("name", "position", "rotation", "velocity", "angular_velocity"),
    *("charge", "pinned", "positions", "velocities"),
}
# Resolutions to try where a model has no voxel; the last ones take a second.
_FINER = [2**k for k in range(2, 11)]
# A clip of the stage has at most so many frames, and bytes. It is what memory holds, and what a sudden end of the
# process costs; for each clip the disk has to confirm four files, which takes some 10 ms each.
CLIP_FRAMES = 24
CLIP_BYTES = 64_000_000
# Above this resolution a model is looked at coarsely first, so that one that cannot fit is refused at once.
LARGE_RESOLUTION = 1024


@dataclass(frozen=True)
class BodyPlan:
    """One body, ready to be built."""

    body: AnyBody
    materials: dict[str, int]
    """Number of jelly cubes of each of its materials, by name, in the order of the lattice."""
    build: Callable[[], Lattice]
    """Makes its particles, springs and surface; the same function for bodies that are made alike."""
    particle_count: int
    spring_bound: int
    """No more springs than this."""
    span_estimate: int
    """About as many spans of springs as this."""
    point_estimate: int
    """About as many points are shown as this."""
    skin_count: int
    """Number of particles on the surface."""
    row_count: int = 0
    """Number of rows along z of vertices of its grid."""
    voxel_count: int = 0
    """Number of jelly cubes."""
    triangle_count: int = 0
    """Number of triangles of its model."""
    model: LoadedModel | None = None
    """The model that it is made from, where it is to be seen."""


@dataclass(frozen=True)
class Plan:
    """All bodies of a scene, and what simulating them takes."""

    scene: Scene
    bodies: list[BodyPlan]

    @property
    def voxel_count(self) -> int:
        """Number of jelly cubes."""
        return sum(plan.voxel_count for plan in self.bodies)

    @property
    def materials(self) -> dict[str, int]:
        """Number of jelly cubes of each material, by name; of those that bodies have."""
        counts: Counter[str] = Counter()
        for plan in self.bodies:
            counts.update(plan.materials)
        return dict(counts)

    @property
    def particle_count(self) -> int:
        """Number of particles."""
        return sum(plan.particle_count for plan in self.bodies)

    @property
    def spring_bound(self) -> int:
        """No more springs than this."""
        return sum(plan.spring_bound for plan in self.bodies)

    @property
    def body_bytes(self) -> dict[str, int]:
        """Estimated share of each body in the peak of memory, bytes by name."""
        return {plan.body.name or "": body_bytes(plan, self.scene, self._samples) for plan in self.bodies}

    @property
    def memory_bytes(self) -> int:
        """Estimated peak of memory, bytes."""
        return peak_bytes(self.bodies, self.scene, self._samples)

    @property
    def _samples(self) -> int:
        """Frames that memory holds at once."""
        return min(self.scene.frame_count, clip_length(sum(plan.point_estimate for plan in self.bodies)))


def clip_length(point_count: int) -> int:
    """Return how many frames of so many points make a clip of the stage."""
    return max(1, min(CLIP_FRAMES, CLIP_BYTES // (BYTES_PER_SAMPLE * max(point_count, 1))))


def plan_scene(scene: Scene, known: Plan | None = None) -> Plan:
    """Find out how every body is made and count what follows from it; once for all that are made alike.

    Args:
        scene: what to plan.
        known: a plan whose bodies are taken over where they are made alike; their models are not read again.

    Raises:
        SceneError: a model cannot be used, or the scene does not fit into memory; the message has the numbers.
    """
    shot = _open_shot(scene)
    plans = {} if known is None else {_making(plan.body, known.scene): plan for plan in known.bodies}
    bodies = []
    for body in scene.bodies:
        making = _making(body, scene)
        if making not in plans:
            plans[making] = _plan_body(body, scene, shot)
        bodies.append(_planned_as(plans[making], body))
    plan = Plan(scene, bodies)
    if shot is not None:
        _require_meshes(shot, plan)
    most = MAX_ROW_BYTES // BYTES_PER_NUMBER[scene.solver.precision]
    if plan.particle_count > most:
        raise SceneError(f"{plan.particle_count:,} particles are more than the {most:,} that arrays can hold")
    what = f"{plan.particle_count:,} particles and {plan.spring_bound:,} springs"
    if len(plan.bodies) > 1:
        name, share = max(plan.body_bytes.items(), key=itemgetter(1))
        what += f", '{name}' {share / 1e9:.1f} GB of it,"
    _require_memory(plan.memory_bytes, what)
    return plan


def _making(body: AnyBody, scene: Scene) -> str:
    """Return what the plan of a body depends on but for the names of its materials, as text."""
    names = _material_names(body)
    # Which of them are the same says which cells are alike, and the law what has to be known of cells.
    alike = [(names.index(name), scene.materials[name].law) for name in names]
    excluded = dict.fromkeys({*PLACEMENT, "material"}, True) | {"regions": {"__all__": {"material"}}}
    shown = scene.output.surface, sorted(scene.output.show)
    return f"{body.model_dump_json(exclude=excluded)} {alike} {scene.up_axis} {shown}"


def _material_names(body: AnyBody) -> list[str]:
    """Return the material of a body, and that of each of its regions."""
    regions = body.regions if isinstance(body, VoxelsBody | ModelBody) else []
    return [body.material, *(region.material for region in regions)]


def _planned_as(plan: BodyPlan, body: AnyBody) -> BodyPlan:
    """Return the plan of a body that is made like another one, with its own place and names of materials."""
    names = dict(zip(_material_names(plan.body), _material_names(body), strict=True))
    return replace(plan, body=body, materials={names[name]: count for name, count in plan.materials.items()})


def _open_shot(scene: Scene) -> Shot | None:
    if scene.output.over is None:
        return None
    # USD takes long to import, and planning other scenes does without.
    from .shot import Shot

    shot = Shot(scene)
    if ends := shot.after(scene.frame_count):
        log.warning(
            "%s: the simulation ends at time code %g and the shot at %g; what it moved rests in between",
            shot.path,
            *ends,
        )
    return shot


def _require_meshes(shot: Shot, plan: Plan) -> None:
    """Refuse meshes of the shot that cannot be written over, or belong to two bodies; warn of motion that is lost."""
    owners: dict[str, str] = {}
    for body_plan in plan.bodies:
        assert body_plan.model is not None
        body = str(body_plan.body.name)
        for prim in body_plan.model.prims:
            shot.require_mesh(prim.path, body, plan.scene.frame_count)
            if not np.isfinite(prim.cage.vertices).all():
                raise SceneError(f"{shot.path}: {prim.path} has coordinates that are not finite numbers")
            if owners.setdefault(prim.path, body) != body:
                raise SceneError(f"bodies.{body}.prim: {prim.path} of {shot.path} belongs to '{owners[prim.path]}' too")
    if stilled := [path for path in owners if shot.moves_before(path)]:
        log.warning(
            "%s: before time code %g, where the simulation starts, points rest as they are then, and not as the shot "
            "moves them: %s",
            *(shot.path, shot.start, listed(stilled, 3)),
        )


def _plan_body(body: AnyBody, scene: Scene, shot: Shot | None) -> BodyPlan:
    """Say how a body is made: the one place that knows every kind."""
    if isinstance(body, NetworkBody):
        build = partial(build_network, body.points, body.springs(), body.rest_lengths)
        springs = sum(map(len, body.springs()))
        shown = 2 * springs + len(body.points)
        return BodyPlan(body, {body.material: 0}, build, len(body.points), springs, springs, shown, len(body.points))
    if isinstance(body, ClothBody):
        particles = body.particles[0] * body.particles[1]
        build = partial(build_cloth, body.size, body.particles)
        return BodyPlan(body, {body.material: 0}, build, particles, 6 * particles, 6 * particles, particles, particles)
    model, triangles = None, 0
    regions: list[Cells] = []
    if isinstance(body, CubeBody):
        cells, cell_size = Cells.of(np.ones((1, 1, 1), bool)), body.size
        origin = np.full(3, -body.size / 2)
    elif isinstance(body, ModelBody):
        time = None if shot is None else shot.start
        voxelized = voxelize_model(body, up_axis=scene.up_axis, time=time)
        cells, origin, cell_size = voxelized.grid.cells, voxelized.grid.origin, voxelized.grid.cell_size
        triangles = len(voxelized.model.mesh.faces)
        model = voxelized.model if scene.output.surface == "model" else None
        regions = voxelized.regions
    else:
        cells, origin, cell_size = body.grid()
        regions = body.region_cells()
    names, materials = _assign_materials(body, cells, regions)
    per_edge = body.particles_per_edge
    weighted = any(scene.materials[name].law == "young" for name in names)
    build = partial(
        build_lattice,
        cells,
        origin=origin,
        cell_size=cell_size,
        particles_per_edge=per_edge,
        weighted=weighted,
        materials=materials,
    )
    counts = count_lattice(cells, particles_per_edge=per_edge, materials=materials)
    surface = {"voxels": counts.sides, "smooth": counts.skin}
    points = {
        SURFACE: len(model.drawing.vertices) if model is not None else surface[scene.output.surface],
        SPRINGS: 2 * counts.spring_bound,
        PARTICLES: counts.particles,
    }
    shown = sum(points[name] for name in set(scene.output.show))
    rows = _count_rows(cells, per_edge)
    cubes = {name: part.count for name, part in zip(names, materials, strict=True)}
    return BodyPlan(
        body,
        cubes,
        build,
        counts.particles,
        counts.spring_bound,
        int(counts.span_estimate * (MIXED_SPANS if len(materials) > 1 else 1)) + YOUNG_SPANS * counts.skin * weighted,
        shown,
        counts.skin,
        rows,
        cells.count,
        triangles,
        model,
    )


def _count_rows(cells: Cells, particles_per_edge: int) -> int:
    """Return the number of rows along z of vertices of a grid."""
    return math.prod(n * (particles_per_edge - 1) + 1 for n in cells.shape[:2])


def _assign_materials(
    body: CubeBody | VoxelsBody | ModelBody, cells: Cells, regions: list[Cells]
) -> tuple[list[str], list[Cells]]:
    """Return the names of a body's materials, and the cells of each: only materials that some cell has.

    Args:
        body: names the material of each region, and that of all other cells.
        cells: of the body.
        regions: cells of each region; of several, the last one counts.

    Raises:
        SceneError: a region has no cell of the body, or there are too many materials.
    """
    materials = {body.material: cells}
    named = [] if isinstance(body, CubeBody) else body.regions
    for number, (region, inside) in enumerate(zip(named, regions, strict=True)):
        selected = cells.within(inside)
        if not selected.count:
            key = next(key for key in region.selectors if getattr(region, key) is not None)
            raise SceneError(
                f"bodies.{body.name}.regions.{number}.{key} = {getattr(region, key)!s}: has no jelly cube of the body; "
                "is it inside of the body, and thick enough for the centre of a cube?"
            )
        materials = {name: others.without(selected) for name, others in materials.items()}
        name = region.material
        materials[name] = materials[name].joined(selected) if name in materials else selected
    materials = {name: part for name, part in materials.items() if part.count}
    if len(materials) > MAX_MATERIALS:
        raise SceneError(f"bodies.{body.name}: has {len(materials)} materials; a body can have {MAX_MATERIALS}")
    return list(materials), list(materials.values())


@dataclass(frozen=True)
class VoxelizedModel:
    """What became of a model."""

    grid: VoxelGrid
    """In metres."""
    watertight: bool
    model: LoadedModel
    """What it was made from, in the frame of the body."""
    regions: list[Cells]
    """Cells of the grid in each of the body's regions."""
    mesh_volume: float
    """m^3; of a closed mesh that does not intersect itself, the volume inside."""
    warnings: list[str]
    """What the user should know, a sentence each; they have been logged, too."""


def voxelize_model(body: ModelBody, *, up_axis: str, time: float | None = None) -> VoxelizedModel:
    """Read and voxelize the model of a body.

    Args:
        body: names the file, and how to voxelize it.
        up_axis: Y or Z; a model that says which axis points up is turned so that this one does.
        time: time code at which the model is read, if it is a USD file; at rest if None.

    Raises:
        InputError: the model cannot be used.
    """
    # These imports take most of a second, which scenes without models need not spend.
    from .meshes import load_model
    from .voxelize import LOOK_RESOLUTION, is_closed, voxelize, voxelize_mesh

    model = load_model(body.file, up_axis=up_axis, prim=body.prim, time=time)
    scale = 1.0 if body.scale is None else body.scale
    if body.fit is not None:
        scale = body.fit / model.mesh.extents.max()
    model = model.scaled(scale)
    mesh, closed = model.mesh, is_closed(model.mesh)
    largest = mesh.extents.max()
    if not MIN_LENGTH <= largest <= MAX_LENGTH:
        raise SceneError(
            f"{body.file}: the model is {largest:.3g} m large; between {MIN_LENGTH:g} and {MAX_LENGTH:g} m can be "
            f"simulated: change bodies.{body.name}.scale or set fit"
        )
    # By the divergence theorem.
    volume = abs(float(np.linalg.det(np.asarray(mesh.triangles)).sum())) / 6
    _require_memory(
        PROGRAM_BYTES + BYTES_PER_CROSSING * _count_crossings(mesh, body, closed=closed),
        f"bodies.{body.name}: voxels at resolution {body.resolution:,}",
    )
    if body.resolution > LARGE_RESOLUTION and closed:
        coarse, _ = voxelize_mesh(mesh, LOOK_RESOLUTION, method=body.method, pieces=body.pieces)
        # The count is right where the mesh overlaps itself, the volume where it is thin.
        count = min(
            coarse.cells.count * (body.resolution / LOOK_RESOLUTION) ** 3, volume * (body.resolution / largest) ** 3
        )
        _require_memory(
            PROGRAM_BYTES + BYTES_PER_BUILT_PARTICLE * count,
            f"bodies.{body.name}: about {count:,.0f} voxels at resolution {body.resolution:,}",
        )
    steps.info("voxelising %s at resolution %s", body.file.name, f"{body.resolution:,}")
    grid, notes = voxelize_mesh(
        mesh, body.resolution, method=body.method, keep_thin_parts=body.keep_thin_parts, pieces=body.pieces
    )
    if not grid.cells.count:
        finer = (n for n in _FINER if n > body.resolution)
        found = next((n for n in finer if voxelize(mesh.triangles, n, method=grid.method).cells.count), None)
        raise SceneError(
            f"{body.file}: no cell of the grid has its centre inside the model at resolution {body.resolution}; "
            + (f"resolution {found} has some, and " if found else "")
            + "keep_thin_parts fills those that it passes through"
        )
    for note in notes:
        log.warning("%s: %s", body.file, note)
    regions = [
        region.grid_cells(grid.cells.shape, grid.origin, grid.cell_size)
        if region.grid is not None
        else _cells_in_mesh(region, body, model, scale, grid, up_axis, time)
        for region in body.regions
    ]
    if body.pieces == "largest":
        model = _without_lost_pieces(model, grid)
    return VoxelizedModel(grid, closed, model, regions, volume, notes)


def _without_lost_pieces(model: LoadedModel, grid: VoxelGrid) -> LoadedModel:
    """Return a model without the pieces of its surface that have no cell of the grid in or beside them."""
    from .polygons import joined
    from .shading import components

    faces, mesh = model.mesh.faces, model.mesh
    piece = components(len(mesh.vertices), np.concatenate([faces[:, 0], faces[:, 1]]), faces[:, [1, 2]].T.ravel())
    cells = np.floor((mesh.vertices - grid.origin) / grid.cell_size).astype(int)
    steps = np.array(list(np.ndindex(3, 3, 3))) - 1
    near = np.any([grid.cells.has(cells + step) for step in steps], axis=0)
    kept = np.isin(piece[faces[:, 0]], piece[near])
    polygons = np.zeros(len(model.drawing.counts), bool)
    polygons[model.mesh_polygons[kept]] = True
    return replace(model, drawing=joined([model.drawing.taken(polygons)]))


def _cells_in_mesh(
    region: ModelRegion,
    body: ModelBody,
    model: LoadedModel,
    scale: float,
    grid: VoxelGrid,
    up_axis: str,
    time: float | None,
) -> Cells:
    """Return the cells of a body's grid whose centres are inside a part of its model or another one.

    Args:
        region: names the part, or the other model, which is in the units of the body's.
        body: what it is a region of.
        model: that of the body, in metres.
        scale: metres per unit.
        grid: of the body, in metres.
        up_axis: as for ``voxelize_model``.
        time: that of the body; other files have no such time, and are read at rest.

    Raises:
        InputError: the model cannot be used.
    """
    from .meshes import load_model
    from .voxelize import MAX_CELLS, voxelize_on_grid

    if region.file is None:
        what, mesh = f"part '{region.part}' of {body.file}", model.part(str(region.part))
    else:
        what = str(region.file)
        then = time if time is not None and region.file.samefile(body.file) else None
        mesh = load_model(region.file, up_axis=up_axis, prim=region.prim, time=then).scaled(scale).mesh
    corners = np.concatenate([mesh.bounds, [grid.origin, grid.origin + np.array(grid.cells.shape) * grid.cell_size]])
    if (cells := np.ptp(corners, axis=0).max() / grid.cell_size) > MAX_CELLS:
        raise SceneError(
            f"{what}: with bodies.{body.name} the model is {cells:,.0f} of its cells long, and at most "
            f"{MAX_CELLS:,} can be searched: is it in the same units?"
        )
    inside, notes = voxelize_on_grid(mesh, grid, keep_thin_parts=body.keep_thin_parts)
    for note in notes:
        log.warning("%s: %s", what, note)
    return inside


def _count_crossings(mesh: trimesh.Trimesh, body: ModelBody, *, closed: bool) -> float:
    """Return about how often rays along the columns of a model's grid cross its surface: as often as it is large."""
    # Twice the area of the triangles as seen along each axis, in cells.
    areas = np.abs(np.cross(*(np.diff(mesh.triangles, axis=1) * (body.resolution / mesh.extents.max())).swapaxes(0, 1)))
    seen = areas.sum(axis=0) / 2
    votes = body.method == "vote" or (body.method == "auto" and not closed)
    return float(seen.sum() if votes else seen[2])


def survey_model(scene: Scene) -> tuple[VoxelGrid, Lattice, dict[str, Any]]:
    """Return the grid and the lattice of a scene's only body, a model, and what becomes of it by name; SI units.

    Raises:
        InputError: the model cannot be used.
    """
    (body,) = scene.bodies
    assert isinstance(body, ModelBody)
    voxelized = voxelize_model(body, up_axis=scene.up_axis)
    grid = voxelized.grid
    counts = count_lattice(grid.cells)
    particles, springs = counts.particles, counts.spring_bound
    needed = PROGRAM_BYTES + BYTES_PER_BUILT_PARTICLE * particles + BYTES_PER_BUILT_SPAN * counts.span_estimate
    needed += BYTES_PER_ROW * _count_rows(grid.cells, 2)
    _require_memory(needed, f"{grid.cells.count:,} voxels, {particles:,} particles and {springs:,} springs")
    lattice = build_lattice(grid.cells, origin=grid.origin, cell_size=grid.cell_size)
    return (
        grid,
        lattice,
        {
            "voxels": grid.cells.count,
            "particles": lattice.particle_count,
            "springs": lattice.spring_count,
            "pieces": len(grid.piece_sizes),
            "watertight": voxelized.watertight,
            "method": grid.method,
            "volume": grid.volume,
            "mesh_volume": voxelized.mesh_volume,
            "warnings": voxelized.warnings,
        },
    )


def _require_memory(needed: float, what: str) -> None:
    available = memory_limit()
    if needed > available:
        raise SceneError(
            f"{what} need about {needed / 1e9:.1f} GB of memory, of {available / 1e9:.1f} GB on this machine; "
            "lower the resolution or the particles per edge"
        )
