"""The scene file: a validated, typed description of what to simulate, and nothing else.

A scene is TOML. Each class here is one table of it; field descriptions carry units and defaults, and
``scenes/schema.json`` (written by ``python -m warpjelly.scene``) carries them into editors.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn, Self

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    StringConstraints,
    Tag,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError

from .cells import Cells
from .errors import SceneError, suggestion
from .files import missing
from .gridfile import read_grid

# Coordinates and lengths beyond this [m], lengths below this [m] and other magnitudes beyond this are typing errors.
MAX_LENGTH = 1e5
MIN_LENGTH = 1e-6
MAX_MAGNITUDE = 1e12
# Speeds [m/s], turning rates [rad/s] and accelerations [m/s^2] beyond this as well.
MAX_RATE = 1e4
# Masses [kg] and densities [kg/m^3] below this have no inverse that float32 can hold beside forces.
MIN_MASS = 1e-9
DEFAULT_PARTICLE_MASS = 0.01  # kg
# A scene asks for at most this many samples and substeps per frame; more would never finish.
MAX_FRAMES = 1_000_000
MAX_SUBSTEPS = 1_000_000
# Time steps beyond these [s] are typing errors.
MIN_STEP, MAX_STEP = 1e-9, 1.0
# Samples per second beyond these as well.
MIN_FPS, MAX_FPS = 0.1, 1e9
# Model files whose meshes are found by prim.
USD_EXTENSIONS = (".usd", ".usda", ".usdc", ".usdz")

Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=MAX_MAGNITUDE)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=MAX_MAGNITUDE)]
Coordinate = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_LENGTH, le=MAX_LENGTH)]
Length = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=MIN_LENGTH, le=MAX_LENGTH)]
Mass = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=MIN_MASS, le=MAX_MAGNITUDE)]
Rate = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_RATE, le=MAX_RATE)]
Step = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=MIN_STEP, le=MAX_STEP)]
Vector = tuple[Number, Number, Number]
Rates = tuple[Rate, Rate, Rate]
Point = tuple[Coordinate, Coordinate, Coordinate]
Switch = Annotated[bool, Field(strict=True)]
Index = Annotated[int, Field(strict=True, ge=0)]
Side = Annotated[int, Field(strict=True, ge=2, le=4096)]
_SPRING_KINDS = ("structural", "shear", "bend")
# Names become prim names in the stage, so they are USD identifiers.
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", max_length=64)]


def refuse(key: str, value: object, why: str) -> NoReturn:
    """Refuse the value of a key, dotted from the table that is being validated; None for a value that is missing."""
    raise PydanticCustomError("scene", "{why}", {"key": key, "why": why, "value": value})


class Table(BaseModel):
    """Base of every table of a scene: immutable, and unknown keys are errors that suggest the right one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _suggest_known_keys(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        for key in data:
            if key not in cls.model_fields:
                hint = suggestion(str(key), cls.model_fields, "known keys")
                raise PydanticCustomError("unknown_key", "{hint}", {"hint": hint, "key": str(key)})
        return data


class Solver(Table):
    """How time advances."""

    integrator: Literal["explicit_euler", "semi_implicit_euler", "rk2", "rk4"] = Field(
        "semi_implicit_euler", description="time integration scheme; rk2 is the midpoint rule, rk4 the classical one"
    )
    dt: Step | Literal["auto"] = Field(
        1e-3,
        description="largest time step, s; the step used is the largest one below it that divides a frame; "
        "auto: a safe share of the largest stable step",
    )
    precision: Literal["float32", "float64"] = Field("float32", description="floating-point type of the simulation")
    culling: Switch = Field(
        True, description="skip contact tests of particles whose bounding box is clear; same result"
    )
    steps_per_frame: int | None = Field(
        None,
        strict=True,
        ge=1,
        le=MAX_SUBSTEPS,
        description="take exactly this many steps of exactly dt between samples; fps is then 1 / (dt * steps) and best "
        "left out. Unless given, dt adapts to fps",
    )


class SpringConstants(Table):
    """Stiffness and damping of one kind of spring, in the units of the material's law."""

    stiffness: NotNegative = Field(100.0, description="N with law strain, N/m with law hooke")
    damping: NotNegative = Field(0.05, description="N s with law strain, N s/m with law hooke")


class Material(Table):
    """What a body is made of."""

    law: Literal["strain", "hooke", "young"] = Field(
        "strain",
        description="strain: force = k (l/r - 1), the same at every spring length; hooke: force = k (l - r); "
        "young: hooke with constants that follow from youngs_modulus, the same body at every resolution",
    )
    particle_mass: Mass | None = Field(
        None, description=f"kg, the same for every particle; {DEFAULT_PARTICLE_MASS} unless density is given"
    )
    density: Mass | None = Field(None, description="kg/m^3; an eighth of a unit cell's mass goes to each corner")
    youngs_modulus: Positive | None = Field(None, description="Pa; with law young, and required there")
    damping_time: NotNegative | None = Field(
        None, description="damping over stiffness of every spring, s; with law young, 5e-4 unless given"
    )
    structural: SpringConstants = Field(SpringConstants(), description="springs to the 6 direct neighbours")
    shear: SpringConstants = Field(SpringConstants(), description="springs to the 12 face and 8 body diagonals")
    bend: SpringConstants = Field(SpringConstants(), description="springs to the second neighbours along each axis")

    @model_validator(mode="after")
    def _keys_go_with_the_law(self) -> Self:
        young = self.law == "young"
        needed = ("youngs_modulus", "density") if young else ()
        unused = (*_SPRING_KINDS, "particle_mass") if young else ("youngs_modulus", "damping_time")
        for key in unused:
            if key in self.model_fields_set and getattr(self, key) is not None:
                takes = "youngs_modulus, density and damping_time" if young else ", ".join(_SPRING_KINDS)
                refuse(key, None, f"does not go with law {self.law}, which takes {takes}")
        for key in needed:
            if getattr(self, key) is None:
                refuse(key, None, "missing; law young requires this key")
        return self

    @model_validator(mode="after")
    def _mass_is_given_once(self) -> Self:
        if self.particle_mass is not None and self.density is not None:
            raise PydanticCustomError("mass", "give particle_mass or density, not both")
        return self

    @model_serializer(mode="wrap")
    def _leave_out_what_the_law_does_not_take(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data: dict[str, Any] = serialize(self)
        return {key: value for key, value in data.items() if self.law != "young" or key not in _SPRING_KINDS}


class Pin(Table):
    """Particles that never move: some by number, or all in a box."""

    indices: list[Index] | None = Field(
        None,
        min_length=1,
        description="numbers of particles in the body: a network's points, otherwise in scan order, z fastest",
    )
    lower: Point | None = Field(None, description="lowest corner of the box, in the body before it is placed, m")
    upper: Point | None = Field(None, description="highest corner of the box, m")

    @model_validator(mode="after")
    def _one_way_is_chosen(self) -> Self:
        box = (self.lower, self.upper)
        if (self.indices is None) == (box == (None, None)) or (self.indices is None and None in box):
            raise PydanticCustomError("pin", "give indices, or lower and upper")
        if self.lower and self.upper and any(a > b for a, b in zip(self.lower, self.upper, strict=True)):
            refuse("lower", list(self.lower), f"must not be above upper, {list(self.upper)}")
        return self


class Region(Table):
    """Some jelly cubes of a body that are of another material than the rest."""

    selectors: ClassVar[tuple[str, ...]]
    """Keys of which each region has one."""

    material: Name = Field(description="one of [materials]")

    @model_validator(mode="after")
    def _one_way_is_chosen(self) -> Self:
        if sum(getattr(self, key) is not None for key in self.selectors) != 1:
            raise PydanticCustomError("region", f"give one of {', '.join(self.selectors)}")
        return self


class Body(Table):
    """What all bodies have: a name, a material, a placement and, maybe, particles that stay where they are."""

    has_volume: ClassVar[bool] = True
    """Whether the body is made of cells, which a density and Young's modulus need."""

    name: Name | None = Field(None, description="prim name in the stage; the type and a number unless given")
    material: Name = Field(description="one of [materials]")
    position: Point = Field((0.0, 0.0, 0.0), description="where the body's origin is put, m")
    rotation: Vector = Field((0.0, 0.0, 0.0), description="degrees about x, then y, then z, through the body's origin")
    velocity: Rates = Field((0.0, 0.0, 0.0), description="of the centre of mass, m/s")
    angular_velocity: Rates = Field((0.0, 0.0, 0.0), description="about the centre of mass, rad/s")
    charge: Number = Field(0.0, description="of each particle, C; what electric and magnetic fields act on")
    pinned: list[Pin] = Field([], description="particles that never move, whatever the body's velocity; none if empty")


class CubeBody(Body):
    """One jelly cube; its origin is its centre."""

    type: Literal["cube"]
    size: Length = Field(1.0, description="edge, m")
    particles_per_edge: int = Field(8, strict=True, ge=2, le=4096, description="particles along an edge")
    positions: list[Point] | None = Field(
        None,
        description="where each particle starts, m, in the axes of the scene: x outermost, z innermost; instead of "
        "position and rotation. The rest shape remains that of size",
    )
    velocities: list[Vector] | None = Field(
        None, description="how each particle starts, m/s, in the same order; instead of velocity and angular_velocity"
    )

    @model_validator(mode="after")
    def _particles_are_given_once(self) -> Self:
        count = self.particles_per_edge**3
        for key, instead in (("positions", ("position", "rotation")), ("velocities", ("velocity", "angular_velocity"))):
            if (given := getattr(self, key)) is None:
                continue
            if len(given) != count:
                what = {"key": key, "given": len(given), "count": count}
                raise PydanticCustomError("particles", "{key} has {given} entries for {count} particles", what)
            for other in instead:
                if any(getattr(self, other)):
                    raise PydanticCustomError(
                        "particles", "give {key} or {other}, not both", {"key": key, "other": other}
                    )
        return self


# Edge of the jelly cubes of a grid, m.
DEFAULT_CELL_SIZE = 0.1


class VoxelsRegion(Region):
    """Cubes of a body of voxels by what is drawn, or by their number in its file."""

    selectors = ("symbol", "value")
    symbol: str | None = Field(None, description="what its cubes are drawn with in layers, one character")
    value: int | None = Field(None, strict=True, ge=1, description="number of its cubes among the cells of the file")

    @field_validator("symbol")
    @classmethod
    def _symbol_is_a_character_of_its_own(cls, symbol: str | None) -> str | None:
        if symbol is not None and (len(symbol) != 1 or symbol in "#."):
            raise PydanticCustomError("symbol", "must be one character, and not # or .")
        return symbol


class VoxelsBody(Body):
    """Jelly cubes on a grid, drawn in the scene around the origin, or from a file."""

    type: Literal["voxels"]
    layers: list[list[str]] | None = Field(
        None,
        min_length=1,
        description="layers along +y from the bottom up; each a list of rows along +z; each row a string along +x "
        "with # for a jelly cube, . for none and the symbols of regions",
    )
    file: Path | None = Field(
        None,
        description="instead of layers an .npz file, relative to the scene file: cells [x, y, z], 0 where there is no "
        "cube, and maybe origin, the lowest corner, and cell_size; `warpjelly voxelize` writes such files",
    )
    cell_size: Length | None = Field(None, description="edge of one jelly cube, m; 0.1 unless a file has its own")
    particles_per_edge: int = Field(
        2, strict=True, ge=2, le=256, description="particles along an edge of each jelly cube"
    )
    regions: list[VoxelsRegion] = Field([], description="cubes of other materials; of several, the last one counts")

    @field_validator("layers")
    @classmethod
    def _layers_form_a_grid(cls, layers: list[list[str]] | None) -> list[list[str]] | None:
        if layers is None:
            return None
        rows, width = len(layers[0]), len(layers[0][0]) if layers[0] else 0
        for y, layer in enumerate(layers):
            if len(layer) != rows:
                raise PydanticCustomError("layers", f"layer {y} has {len(layer)} rows, layer 0 has {rows}")
            for z, row in enumerate(layer):
                if len(row) != width:
                    why = f"row {z} of layer {y} has {len(row)} cells, row 0 of layer 0 has {width}"
                    raise PydanticCustomError("layers", why)
        if not any(set(row) - {"."} for layer in layers for row in layer):
            raise PydanticCustomError("layers", "the grid has no jelly cube (#)")
        return layers

    @field_validator("file", mode="after")
    @classmethod
    def _file_is_relative_to_the_scene(cls, file: Path | None, info: ValidationInfo) -> Path | None:
        return None if file is None else _existing(file, info)

    @model_validator(mode="after")
    def _there_is_one_grid(self) -> Self:
        if (self.layers is None) == (self.file is None):
            raise PydanticCustomError("layers", "give either layers or file")
        if self.file is not None:
            self.grid()
        return self

    @model_validator(mode="after")
    def _regions_go_with_the_grid(self) -> Self:
        key, other = ("symbol", "layers") if self.layers is not None else ("value", "file")
        for number, region in enumerate(self.regions):
            if getattr(region, key) is None:
                refuse(f"regions.{number}", None, f"give {key}, which goes with {other}")
        symbols = [region.symbol for region in self.regions]
        for y, layer in enumerate(self.layers or []):
            if stray := set("".join(layer)) - {"#", ".", *symbols}:
                why = f"layer {y} has {min(stray)!r}; use # for a cube, . for none, or the symbol of one of its regions"
                refuse("layers", self.layers, why)
        return self

    def grid(self) -> tuple[Cells, np.ndarray, float]:
        """Return the occupied cells, the lowest corner of the grid, [3], m, and the edge of a cell, m."""
        return self.kept_grid

    @cached_property
    def kept_grid(self) -> tuple[Cells, np.ndarray, float]:
        """What ``grid`` returns, so that a file is read once."""
        if self.file is not None:
            cells, origin, own = _read_grid(self.file)
            own = DEFAULT_CELL_SIZE if own is None else own
            origin = -np.array(cells.shape) * own / 2 if origin is None else origin
            scale = 1.0 if self.cell_size is None else self.cell_size / own
            return cells, scale * origin, scale * own
        cells = Cells.of(self._drawing() != ".")
        cell_size = DEFAULT_CELL_SIZE if self.cell_size is None else self.cell_size
        return cells, -np.array(cells.shape) * cell_size / 2, cell_size

    def region_cells(self) -> list[Cells]:
        """Return the cells of each region."""
        if self.file is not None:
            return [_read_grid(self.file, region.value)[0] for region in self.regions]
        return [Cells.of(self._drawing() == region.symbol) for region in self.regions]

    def _drawing(self) -> np.ndarray:
        """Return the characters of the layers, [x, y, z]."""
        drawn = np.array([[list(row) for row in layer] for layer in self.layers or []])
        return drawn.transpose(2, 0, 1)


def _read_grid(file: Path, value: int | None = None) -> tuple[Cells, np.ndarray | None, float | None]:
    """Read the cells of an .npz file that have a value, or are not 0, and what there is of origin [3] and cell size."""
    try:
        cells, origin, own = read_grid(file, value)
        if value is None and not cells.count:
            raise ValueError("none of its cells is occupied")
        sized = own is None or MIN_LENGTH <= own <= MAX_LENGTH
        if not sized or not (origin is None or np.abs(origin).max() <= MAX_LENGTH):
            given = "none" if origin is None else origin.tolist()
            raise ValueError(f"origin and cell_size must be lengths in m, not {given} and {own or 'none'}")
    # Reading raises whatever it happens to trip over; all of it means that the file is broken.
    except Exception as error:
        what = {"file": str(file), "why": str(error) or type(error).__name__}
        raise PydanticCustomError("grid", "{file}: not a grid of voxels: {why}", what) from error
    return cells, origin, own


def _existing(file: Path, info: ValidationInfo) -> Path:
    """Return the full path of a file that is given relative to the scene file."""
    file = Path((info.context or {}).get("folder", "."), file).absolute()
    if why := missing(file):
        raise PydanticCustomError("file", "{why} ({path})", {"why": why, "path": str(file)})
    return file


class ModelRegion(Region):
    """Cubes of a model by another model, a part of the model itself, or a grid."""

    selectors = ("file", "part", "grid")
    file: Path | None = Field(
        None,
        description="another model, in the frame and the units of the body's, relative to the scene file: the cubes "
        "whose centres are inside",
    )
    prim: str | None = Field(
        None, description="of a USD file, the prim whose meshes are read; the default prim unless given"
    )
    part: str | None = Field(
        None,
        description="name of an object, group, node, prim or material of the body's own file: the cubes whose centres "
        "are inside its faces",
    )
    grid: Path | None = Field(
        None,
        description="an .npz file, relative to the scene file: the cubes whose centres are in its cells [x, y, z] that "
        "are not 0, with origin and cell_size in m in the body's frame; without these it is the body's grid",
    )
    value: int | None = Field(None, strict=True, ge=1, description="of a grid, only cells with this number")

    @field_validator("file", "grid", mode="after")
    @classmethod
    def _files_are_relative_to_the_scene(cls, file: Path | None, info: ValidationInfo) -> Path | None:
        return None if file is None else _existing(file, info)

    @model_validator(mode="after")
    def _keys_go_together(self) -> Self:
        if self.prim is not None and (self.file is None or self.file.suffix.lower() not in USD_EXTENSIONS):
            refuse("prim", self.prim, f"only USD files have prims: {' '.join(USD_EXTENSIONS)}")
        if self.value is not None and self.grid is None:
            refuse("value", self.value, "goes with grid alone")
        if self.grid is not None:
            _read_grid(self.grid)
        return self

    def grid_cells(self, shape: tuple[int, int, int], origin: np.ndarray, cell_size: float) -> Cells:
        """Return the cells of a body's grid whose centres are in this region's grid.

        Args:
            shape: of the body's grid, (nx, ny, nz).
            origin: its lowest corner, [3], m.
            cell_size: edge of its cells, m.

        Raises:
            SceneError: the file does not say where its cells are, and they are not those of the body's grid.
        """
        assert self.grid is not None
        cells, own_origin, own_size = _read_grid(self.grid, self.value)
        if own_origin is None or own_size is None:
            if cells.shape != shape:
                whose = f"{list(cells.shape)} of them, and the body's grid has {list(shape)}"
                raise SceneError(f"{self.grid}: has no origin and cell_size to say where its cells are: {whose}")
            return cells
        return cells.sampled(
            [
                np.floor((low + (np.arange(count) + 0.5) * cell_size - own_low) / own_size)
                for count, low, own_low in zip(shape, origin, own_origin, strict=True)
            ]
        )


class ModelBody(Body):
    """A mesh turned into jelly cubes; the origin is that of the model file."""

    type: Literal["model"]
    file: Path = Field(
        description="OBJ, STL, PLY, OFF, GLB, glTF, USD, 3MF or DAE file, relative to the scene file; what it says of "
        "its unit and its up axis is applied: metres, and the up axis of the scene"
    )
    prim: str | None = Field(
        None,
        description="of a USD file, the prim whose meshes are read, like /World/thing; the default prim unless given",
    )
    scale: Length | None = Field(
        None, description="metres per unit of the model file, or a factor where the file says its unit; 1 unless given"
    )
    fit: Length | None = Field(None, description="largest extent of the model along its axes, m, instead of scale")
    resolution: int = Field(strict=True, ge=1, le=4096, description="jelly cubes along the longest edge")
    particles_per_edge: int = Field(
        2, strict=True, ge=2, le=256, description="particles along an edge of each jelly cube"
    )
    method: Literal["auto", "parity", "winding", "vote"] = Field(
        "auto",
        description="how cells are told to be inside: by an odd number of crossings of a ray; by the surface going "
        "round them, for meshes that intersect themselves; or by three axes, for meshes with holes",
    )
    keep_thin_parts: Switch = Field(
        False, description="fill the cells, too, that a part passes through which is thinner than a cell"
    )
    pieces: Literal["all", "largest"] = Field(
        "all", description="of pieces that no face joins, keep each, moving by itself, or the largest alone"
    )
    regions: list[ModelRegion] = Field([], description="cubes of other materials; of several, the last one counts")

    @field_validator("file", mode="after")
    @classmethod
    def _file_is_relative_to_the_scene(cls, file: Path, info: ValidationInfo) -> Path:
        return _existing(file, info)

    @model_validator(mode="after")
    def _keys_go_together(self) -> Self:
        if self.fit is not None and self.scale is not None:
            refuse("fit", self.fit, "give scale or fit, not both")
        if self.prim is not None and self.file.suffix.lower() not in USD_EXTENSIONS:
            refuse("prim", self.prim, f"only USD files have prims: {' '.join(USD_EXTENSIONS)}")
        return self


class Contact(Table):
    """How colliders push back, unless they say otherwise themselves; all per particle in contact."""

    stiffness: Positive = Field(2000.0, description="N/m of penetration depth")
    damping: NotNegative = Field(1.0, description="N s/m along the normal")
    static_friction: NotNegative = Field(0.6, description="largest friction at rest, share of the normal force")
    dynamic_friction: NotNegative = Field(
        0.4, description="friction in motion, share of the normal force; at most static_friction"
    )
    pulls: Switch = Field(False, description="let the damper also pull a particle that leaves")
    normal_force_term: Switch = Field(
        False,
        description="add what presses a particle in, so that it does not sink; feeds energy, and bodies bounce higher",
    )
    friction_normal: Literal["reaction", "applied"] = Field(
        "reaction", description="friction is a share of the collider's force, or of what presses the particle in"
    )


class NetworkBody(Body):
    """Points and the springs between them, as given; the origin is that of the points."""

    has_volume: ClassVar[bool] = False
    type: Literal["network"]
    points: list[Point] = Field(min_length=1, description="where the particles start, m")
    structural: list[tuple[Index, Index]] = Field([], description="pairs of points, joined by structural springs")
    shear: list[tuple[Index, Index]] = Field([], description="pairs of points, joined by shear springs")
    bend: list[tuple[Index, Index]] = Field([], description="pairs of points, joined by bend springs")
    rest_lengths: list[Length] | None = Field(
        None,
        description="m, one for each spring: the structural ones, then shear, then bend; "
        "the distances of the points unless given",
    )

    @model_validator(mode="after")
    def _springs_join_points(self) -> Self:
        taken: dict[frozenset[int], str] = {}
        for kind in _SPRING_KINDS:
            for number, (i, j) in enumerate(getattr(self, kind)):
                key, ends = f"{kind}.{number}", [i, j]
                if max(i, j) >= len(self.points):
                    refuse(key, ends, f"there is no particle {max(i, j)}; points are 0 to {len(self.points) - 1}")
                if i == j:
                    refuse(key, ends, "a spring joins two different particles")
                if earlier := taken.get(frozenset(ends)):
                    refuse(key, ends, f"these particles are joined by {earlier} already")
                taken[frozenset(ends)] = key
                if self.rest_lengths is None and math.dist(self.points[i], self.points[j]) < MIN_LENGTH:
                    why = f"its rest length must be at least {MIN_LENGTH:g} m: move a point, or give rest_lengths"
                    refuse(key, ends, why)
        if self.rest_lengths is not None and len(self.rest_lengths) != len(taken):
            refuse("rest_lengths", self.rest_lengths, f"{len(self.rest_lengths)} of them for {len(taken)} springs")
        return self

    def springs(self) -> list[list[tuple[int, int]]]:
        """Return both ends of the springs: structural, shear, bend."""
        return [self.structural, self.shear, self.bend]


class ClothBody(Body):
    """A rectangular sheet in the body's x-z plane; its origin is its centre."""

    has_volume: ClassVar[bool] = False
    type: Literal["cloth"]
    size: tuple[Length, Length] = Field((1.0, 1.0), description="sides along x and z, m")
    particles: tuple[Side, Side] = Field((16, 16), description="particles along the sides, at least 2 each")


class SoftContact(Table):
    """How bodies push each other apart: particles of the skin are balls."""

    mode: Literal["bodies", "all", "off"] = Field(
        "bodies", description="bodies: different bodies collide; all: a body with itself as well, where it folds over"
    )
    stiffness: Positive = Field(1000.0, description="N/m of overlap")
    damping: NotNegative = Field(0.5, description="N s/m along the line of centres")
    friction: NotNegative = Field(0.3, description="share of the normal force")
    radius: Length | None = Field(None, description="of the balls, m; half the edge of a body's unit cell unless given")


class Collider(Table):
    """What all colliders have: a name, and what they do otherwise than [contact]."""

    name: Name | None = Field(None, description="prim name in the stage; the type and a number unless given")
    stiffness: Positive | None = Field(None, description="N/m of penetration depth, per particle")
    damping: NotNegative | None = Field(None, description="N s/m along the normal, per particle")
    static_friction: NotNegative | None = Field(None, description="largest friction at rest, share of the normal force")
    dynamic_friction: NotNegative | None = Field(None, description="friction in motion, share of the normal force")
    pulls: Switch | None = Field(None, description="let the damper also pull a particle that leaves")


def _require_direction(vector: tuple[float, float, float], what: str) -> None:
    if math.hypot(*vector) < 1e-9:
        raise PydanticCustomError("direction", "{what} must not be zero", {"what": what})


class HalfSpaceCollider(Collider):
    """An infinite flat wall; each body stays on the side where its centre of mass starts."""

    type: Literal["half_space"]
    center: Point = Field((0.0, 0.0, 0.0), description="a point of the wall, m")
    normal: Vector = Field(description="perpendicular to the wall; any length")

    @model_validator(mode="after")
    def _normal_is_a_direction(self) -> Self:
        _require_direction(self.normal, "normal")
        return self


class PlaneCollider(Collider):
    """A rectangle that stops what comes through it from the front."""

    type: Literal["plane"]
    center: Point = Field((0.0, 0.0, 0.0), description="m")
    normal: Vector = Field(description="points out of the front; any length")
    tangent: Vector | None = Field(None, description="direction of the first side; chosen unless given")
    size: tuple[Length, Length] = Field(description="both sides, m")
    threshold: Length = Field(0.1, description="depth beyond which the force does not grow, m")

    @model_validator(mode="after")
    def _directions_span_the_plane(self) -> Self:
        _require_direction(self.normal, "normal")
        if self.tangent is not None:
            _require_direction(self.tangent, "tangent")
            n, t = np.array(self.normal), np.array(self.tangent)
            if np.linalg.norm(np.cross(n, t)) < 1e-6 * np.linalg.norm(n) * np.linalg.norm(t):
                raise PydanticCustomError("direction", "tangent must not be parallel to normal")
        return self

    def frame(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the unit vectors (tangent, bitangent, normal), float64 [3] each, right-handed."""
        return plane_frame(self.normal, self.tangent)


def plane_frame(normal: Sequence[float], tangent: Sequence[float] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the unit vectors (tangent, bitangent, normal) of a plane, float64 [3] each, right-handed.

    Args:
        normal: of any length, [3].
        tangent: direction of the first side, made perpendicular to the normal, [3]; chosen unless given.
    """
    n = np.array(normal) / np.linalg.norm(normal)
    # Without a tangent, the axis that is least aligned with the normal gives the best-conditioned one.
    t = np.array(tangent) if tangent is not None else np.eye(3)[np.argmin(np.abs(n))]
    t = t - n * (t @ n)
    t /= np.linalg.norm(t)
    return t, np.cross(n, t), n


class SphereCollider(Collider):
    """A solid ball."""

    type: Literal["sphere"]
    center: Point = Field((0.0, 0.0, 0.0), description="m")
    radius: Length = Field(description="m")
    normal: Literal["radial", "entry"] = Field(
        "radial", description="push straight out, or towards where the particle came in"
    )


class BoxCollider(Collider):
    """A room: bodies stay inside its six walls."""

    type: Literal["box"]
    center: Point = Field((0.0, 0.0, 0.0), description="m")
    size: tuple[Length, Length, Length] = Field(description="edges along x, y and z, m")


class ForceField(Table):
    """What all fields have: a curve over time."""

    curve: list[tuple[Number, Number]] | None = Field(
        None,
        min_length=1,
        description="keyframes [time in s, factor], times ascending: the field is multiplied by the factor, linear in "
        "between and constant outside; always 1 unless given",
    )

    @field_validator("curve")
    @classmethod
    def _times_ascend(cls, curve: list[tuple[float, float]] | None) -> list[tuple[float, float]] | None:
        for i, (before, after) in enumerate(pairwise(curve or [])):
            if not before[0] < after[0]:
                what = {"i": i + 1, "after": after[0], "before": before[0]}
                raise PydanticCustomError("curve", "times must ascend; entry {i}, {after} s, follows {before} s", what)
        return curve


class ConstantField(ForceField):
    """The same force everywhere."""

    type: Literal["constant"]
    force: Vector = Field(description="on each particle, N")


class GridField(ForceField):
    """Forces at R x R x R nodes over a box, trilinear in between."""

    type: Literal["grid"]
    lower: Point = Field(description="corner of the box, where the first node is, m")
    upper: Point = Field(description="opposite corner, m")
    forces: Annotated[list[Vector], WithJsonSchema({"type": "array"})] | None = Field(
        None,
        description="force on each particle at each node, N: x outermost, z innermost, nested or flat; R follows",
    )
    file: Path | None = Field(
        None,
        description="the forces in a NumPy file, relative to the scene file: .npy, or .npz with one array; [R, R, R, 3]"
        " or [R^3, 3]",
    )
    outside: Literal["clamp", "zero"] = Field(
        "clamp", description="force outside the box; clamp: that of the nearest point of the box"
    )

    @field_validator("forces", mode="before")
    @classmethod
    def _flatten(cls, forces: Any) -> Any:
        def nests(entry: Any) -> bool:
            return isinstance(entry, list | tuple) and len(entry) > 0 and isinstance(entry[0], list | tuple)

        # Vectors lie under one level of lists, or under three.
        for _ in range(2):
            if isinstance(forces, list | tuple) and all(nests(entry) for entry in forces):
                forces = [inner for entry in forces for inner in entry]
        return forces

    @field_validator("file", mode="after")
    @classmethod
    def _file_is_relative_to_the_scene(cls, file: Path | None, info: ValidationInfo) -> Path | None:
        return None if file is None else _existing(file, info)

    @model_validator(mode="after")
    def _nodes_fill_the_box(self) -> Self:
        if (self.forces is None) == (self.file is None):
            raise PydanticCustomError("grid", "give either forces or file")
        if any(a >= b for a, b in zip(self.lower, self.upper, strict=True)):
            raise PydanticCustomError("grid", "lower must be below upper along every axis")
        self.nodes()
        return self

    def nodes(self) -> np.ndarray:
        """Return the forces at the nodes, float64 [R, R, R, 3], N."""
        source = "forces" if self.file is None else str(self.file)
        data = np.array(self.forces, float) if self.file is None else _read_array(self.file)
        resolution = round((data.size / 3) ** (1 / 3))
        if resolution < 2 or data.shape not in [(resolution**3, 3), (resolution,) * 3 + (3,)]:
            what = {"source": source, "shape": str(list(data.shape))}
            raise PydanticCustomError(
                "grid", "{source}: has the shape {shape}; it must be [R, R, R, 3] or [R^3, 3] with R at least 2", what
            )
        if not np.abs(data).max() <= MAX_MAGNITUDE:
            raise PydanticCustomError("grid", "{source}: has forces that are not finite or absurd", {"source": source})
        return data.reshape(resolution, resolution, resolution, 3)


def _read_array(file: Path) -> np.ndarray:
    """Read a .npy file, or a .npz file with one array, as float64."""
    try:
        data = np.load(file, allow_pickle=False)
        if not isinstance(data, np.ndarray):
            with data:
                (name,) = data.files
                data = data[name]
        if not isinstance(data, np.ndarray) or data.dtype.kind not in "fiu":
            raise ValueError(f"it holds {getattr(data, 'dtype', 'something else')}")
        return data.astype(float)
    # NumPy raises whatever its parsing happens to trip over; all of it means that the file is broken.
    except Exception as error:
        what = {"file": str(file), "why": str(error) or type(error).__name__}
        raise PydanticCustomError("grid", "{file}: not a NumPy file with one array of numbers: {why}", what) from error


class ElectricField(ForceField):
    """A uniform electric field: force q E."""

    type: Literal["electric"]
    strength: Vector = Field(description="E, V/m")


class MagneticField(ForceField):
    """A uniform magnetic field: force q v x B."""

    type: Literal["magnetic"]
    strength: Vector = Field(description="B, T")


class Output(Table):
    """What is written."""

    format: Literal["usdc", "clips"] = Field(
        "usdc",
        description="what a finished run leaves: one self-contained stage.usdc; or stage.usda, geometry.usdc and the "
        "frames in files below clips/, as while the run is going, which takes no time and no space at the end",
    )
    surface: Literal["voxels", "smooth", "model"] = Field(
        "voxels",
        description="what the surface of a body of cells is: the faces of its cells, hard where their directions meet; "
        "the same without steps; or the model that it was made from, deformed",
    )
    look: Literal["model", "force"] = Field(
        "model",
        description="with surface model: the materials of the model, where it has any, or the colours of forces",
    )
    show: list[Literal["surface", "springs", "particles"]] = Field(
        ["surface"],
        min_length=1,
        description="what is shown of a body; networks, which have no surface, always show springs and particles",
    )
    spring_colors: Literal["force", "kind"] = Field(
        "force", description="what the colours of springs show: forces on their ends, or structural, shear and bend"
    )
    force_range: tuple[NotNegative, NotNegative] | Literal["auto"] = Field(
        "auto", description="forces at both ends of the colour map, N; auto: 1st to 99th percentile of the run"
    )
    color: Literal["indexed", "rgb"] = Field(
        "indexed", description="indexed: a colour table and one small index per point; rgb: for readers without indices"
    )
    velocities: Switch = Field(False, description="write point velocities, for motion blur")
    forces: Switch = Field(False, description="write the force on each point, N, as primvars:force")
    over: Path | None = Field(
        None,
        description="a USD stage, the shot, relative to the scene file, which bodies are taken from where they stand: "
        "what is written is a layer with the motion of their meshes, over the shot, and a root with both",
    )
    start: Number | None = Field(
        None, description="with over, time code of the shot where the simulation starts; its first unless given"
    )

    @model_validator(mode="before")
    @classmethod
    def _meshes_are_shown_over_a_shot(cls, data: Any) -> Any:
        return {"surface": "model", **data} if isinstance(data, Mapping) and data.get("over") is not None else data

    @field_validator("over", mode="after")
    @classmethod
    def _shot_is_relative_to_the_scene(cls, over: Path | None, info: ValidationInfo) -> Path | None:
        return None if over is None else _existing(over, info)

    @model_validator(mode="after")
    def _keys_go_with_a_shot(self) -> Self:
        if self.over is None and self.start is not None:
            refuse("start", self.start, "goes with over")
        if self.over is None:
            return self
        if self.over.suffix.lower() not in USD_EXTENSIONS:
            refuse("over", str(self.over), f"must be a USD stage: {' '.join(USD_EXTENSIONS)}")
        for key in ("look", "show", "spring_colors", "force_range", "color"):
            if key in self.model_fields_set and getattr(self, key) != type(self).model_fields[key].default:
                refuse(key, getattr(self, key), "does not go with over: meshes keep the look that the shot gives them")
        if self.surface != "model":
            refuse("surface", self.surface, "does not go with over, which moves the meshes of the shot: leave it out")
        return self

    @model_validator(mode="after")
    def _look_goes_with_a_model(self) -> Self:
        if "look" in self.model_fields_set and self.look != "model" and self.surface != "model":
            refuse("look", self.look, f"goes with surface model, and the surface is {self.surface}")
        return self

    @field_validator("force_range")
    @classmethod
    def _range_ascends(cls, value: Any) -> Any:
        if value != "auto" and not value[0] < value[1]:
            raise PydanticCustomError("range", "the first force must be below the second")
        return value


class Expectation(Table):
    """Bounds on one measured quantity; at least one of them."""

    body: Name | None = Field(None, description="which body is measured; may be left out when there is one")
    min: Number | None = Field(None, description="smallest allowed value")
    max: Number | None = Field(None, description="largest allowed value")

    @model_validator(mode="after")
    def _something_is_bounded(self) -> Self:
        if self.min is None and self.max is None:
            raise PydanticCustomError("expectation", "give min, max or both")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise PydanticCustomError("expectation", "min must not be above max")
        return self


# Bounds on one body, or a list of bounds on several. The tags are in brackets so that errors do not name them.
Expectations = Annotated[
    Annotated[Expectation, Tag("[one]")] | Annotated[list[Expectation], Field(min_length=1), Tag("[several]")],
    Discriminator(lambda given: "[several]" if isinstance(given, list) else "[one]"),
]


class Expect(Table):
    """What the scene is for, as numbers; ``warpjelly run`` measures and reports them. A list bounds several bodies."""

    rest_height: Expectations | None = Field(None, description="height of the centre of mass at the end, m")
    displacement: Expectations | None = Field(
        None, description="distance of the centre of mass from its start at the end, m"
    )
    reach: Expectations | None = Field(
        None, description="greatest distance of the centre of mass from its start over the run, m"
    )
    rotation: Expectations | None = Field(
        None, description="angle of the best rigid fit of the first shape at the end, degrees, at most 180"
    )
    speed: Expectations | None = Field(None, description="greatest particle speed at the end, m/s")
    shape_error: Expectations | None = Field(
        None,
        description="rms distance from the best rigid fit of the first shape at the end, share of the body's diagonal",
    )
    squash: Expectations | None = Field(None, description="least height of the body over the run, share of its first")
    bounce: Expectations | None = Field(None, description="greatest rise of the centre of mass after its first low, m")
    penetration: Expectations | None = Field(
        None, description="greatest depth of a particle in a collider over the run, in unit cells"
    )
    diverges: Expectations | None = Field(
        None, description="1 if the run diverged, otherwise 0; a scene that is to diverge says { min = 1.0 }"
    )

    def items(self) -> Iterator[tuple[str, str, Expectation]]:
        """Yield what is bounded: its dotted key in this table, the quantity, the bounds."""
        for name in type(self).model_fields:
            given = getattr(self, name)
            if isinstance(given, list):
                yield from ((f"{name}.{i}", name, expectation) for i, expectation in enumerate(given))
            elif given is not None:
                yield name, name, given


AnyBody = Annotated[CubeBody | VoxelsBody | ModelBody | NetworkBody | ClothBody, Field(discriminator="type")]
AnyCollider = Annotated[HalfSpaceCollider | PlaneCollider | SphereCollider | BoxCollider, Field(discriminator="type")]
AnyField = Annotated[ConstantField | GridField | ElectricField | MagneticField, Field(discriminator="type")]


class Scene(Table):
    """A whole scene."""

    name: Name = Field("scene", description="names the run directory; the file's name unless given")
    duration: Positive | None = Field(None, description="s; 2 unless frames is given")
    frames: int | None = Field(
        None, strict=True, ge=1, le=MAX_FRAMES, description="number of samples, instead of duration"
    )
    fps: float = Field(60.0, strict=True, allow_inf_nan=False, ge=MIN_FPS, le=MAX_FPS, description="samples per second")
    up_axis: Literal["Y", "Z"] = Field("Y", description="which axis points up")
    gravity: Rates | None = Field(None, description="m/s^2; 9.81 downwards unless given")
    solver: Solver = Field(Solver(), description="time integration")
    materials: dict[Name, Material] = Field(min_length=1, description="materials by name")
    bodies: list[AnyBody] = Field(min_length=1, description="what is made of jelly")
    contact: Contact = Field(Contact(), description="how colliders push back unless they say otherwise")
    soft_contact: SoftContact = Field(SoftContact(), description="how bodies push each other apart")
    colliders: list[AnyCollider] = Field([], description="what the bodies collide with")
    fields: list[AnyField] = Field([], description="forces on every particle, besides gravity")
    output: Output = Field(Output(), description="what is written")
    expect: Expect = Field(Expect(), description="what the scene is for, as numbers")

    @model_validator(mode="before")
    @classmethod
    def _name_nameless_prims(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        for key in ("bodies", "colliders"):
            if isinstance(entries := data.get(key), Sequence) and not isinstance(entries, str):
                data[key] = [
                    {"name": f"{entry.get('type', 'unknown')}_{i}", **entry} if isinstance(entry, Mapping) else entry
                    for i, entry in enumerate(entries)
                ]
        return data

    @model_validator(mode="before")
    @classmethod
    def _let_fps_follow_exact_steps(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or "fps" in data or not isinstance(data.get("solver"), Mapping):
            return data
        steps, dt = data["solver"].get("steps_per_frame"), data["solver"].get("dt", Solver.model_fields["dt"].default)
        # Whatever is no such number is refused where it belongs.
        counted = isinstance(steps, int) and 1 <= steps <= MAX_SUBSTEPS
        timed = isinstance(dt, float | int) and MIN_STEP <= dt <= MAX_STEP
        if not (counted and timed):
            return data
        if steps * dt > 1.0 / MIN_FPS:
            why = f"with solver.dt = {dt:g} s that is a sample every {steps * dt:g} s; at most {1.0 / MIN_FPS:g} s"
            refuse("solver.steps_per_frame", steps, why)
        return {**data, "fps": 1.0 / (steps * dt)}

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        for key, parts in (("bodies", self.bodies), ("colliders", self.colliders)):
            for i, part in enumerate(parts):
                if part.name in [earlier.name for earlier in parts[:i]]:
                    refuse(f"{key}.{i}.name", part.name, "this name is taken; names must differ")
        for i, body in enumerate(self.bodies):
            named = {f"bodies.{i}.material": body.material}
            regions = body.regions if isinstance(body, VoxelsBody | ModelBody) else []
            named |= {f"bodies.{i}.regions.{k}.material": region.material for k, region in enumerate(regions)}
            for key, name in named.items():
                if name not in self.materials:
                    refuse(key, name, f"no such material; materials of this scene: {', '.join(self.materials)}")
            material = self.materials[body.material]
            if not body.has_volume and material.density is not None:
                why = f"it has a density, but a {body.type} has no volume: use particle_mass, and law strain or hooke"
                refuse(f"bodies.{i}.material", body.material, why)
        contacts = {f"colliders.{i}": self.contact_of(collider) for i, collider in enumerate(self.colliders)}
        for key, contact in ({"contact": self.contact} | contacts).items():
            if contact.dynamic_friction > contact.static_friction:
                why = f"must not be above static_friction, which is {contact.static_friction:g}"
                if key != "contact":
                    why += "; [contact] has what a collider does not say"
                refuse(f"{key}.dynamic_friction", contact.dynamic_friction, why)
        for key, _, expectation in self.expect.items():
            bodies = ", ".join(str(body.name) for body in self.bodies)
            if expectation.body is None and len(self.bodies) > 1:
                refuse(f"expect.{key}.body", None, f"name one of the bodies: {bodies}")
            if expectation.body is not None and expectation.body not in bodies.split(", "):
                refuse(f"expect.{key}.body", expectation.body, f"no such body; bodies: {bodies}")
        if self.output.over is not None:
            self._require_bodies_of(self.output.over)
        if self.output.surface == "model" and not any(isinstance(body, ModelBody) for body in self.bodies):
            refuse("output.surface", "model", "no body is of type model; choose voxels or smooth")
        if self.duration is not None and self.frames is not None:
            refuse("duration", self.duration, "give duration or frames, not both")
        if self.duration is not None and not 1 <= round(self.duration * self.fps) <= MAX_FRAMES:
            refuse("duration", self.duration, f"at {self.fps:g} fps this is not between 1 and {MAX_FRAMES} frames")
        steps, dt = self.solver.steps_per_frame, self.solver.dt
        if steps is not None:
            if dt == "auto":
                refuse("solver.dt", "auto", "give a number with solver.steps_per_frame")
            if not math.isclose(self.fps * steps * dt, 1.0, rel_tol=1e-9):
                fps = 1.0 / (steps * dt)
                refuse("fps", self.fps, f"leave it out; solver.steps_per_frame and solver.dt make it {fps:.9g}")
        if self.solver.dt != "auto" and self.substeps_for(self.solver.dt) > MAX_SUBSTEPS:
            refuse("solver.dt", self.solver.dt, f"more than {MAX_SUBSTEPS} substeps a frame at {self.fps:g} fps")
        return self

    def _require_bodies_of(self, shot: Path) -> None:
        """Refuse bodies that are not as they are in a shot."""
        for i, body in enumerate(self.bodies):
            if not isinstance(body, ModelBody):
                why = "with output.over each body is a model from the shot; put others into it first, or in another run"
                refuse(f"bodies.{i}.type", body.type, why)
            if not body.file.samefile(shot):
                why = f"with output.over each body is a part of the shot, {shot}; put others into it first"
                refuse(f"bodies.{i}.file", str(body.file), why)
            if body.prim is None:
                refuse(f"bodies.{i}.prim", None, "missing; with output.over, name the prim of the shot that is to move")
            for key in ("scale", "fit"):
                if getattr(body, key) is not None:
                    why = "does not go with output.over: a body is as large as in the shot"
                    refuse(f"bodies.{i}.{key}", getattr(body, key), why)

    @property
    def frame_count(self) -> int:
        """Number of samples, at time codes 0 to ``frame_count - 1``; the first is the initial state."""
        return self.frames if self.frames is not None else round((self.duration or 2.0) * self.fps)

    def contact_of(self, collider: AnyCollider) -> Contact:
        """Return how a collider pushes back: what it says itself, and [contact] where it says nothing."""
        own = {name: value for name in Contact.model_fields if (value := getattr(collider, name, None)) is not None}
        return self.contact.model_copy(update=own)

    @property
    def soft_contacts(self) -> bool:
        """Whether particles may collide with each other."""
        return self.soft_contact.mode == "all" or (self.soft_contact.mode == "bodies" and len(self.bodies) > 1)

    def substeps_for(self, largest: float) -> int:
        """Return the substeps per frame of the largest step that divides a frame and does not exceed ``largest``, s."""
        if self.solver.steps_per_frame is not None:
            return self.solver.steps_per_frame
        # The tolerance keeps 1/60 s at 1/600 s at ten substeps, whatever the last bit of the quotient.
        return max(1, math.ceil(1.0 / (self.fps * largest) * (1 - 1e-9)))

    def dt_for(self, substeps: int) -> float:
        """Return the time step of so many substeps per frame, s; with ``solver.steps_per_frame`` it is dt, exactly."""
        if self.solver.steps_per_frame is not None and self.solver.dt != "auto":
            return self.solver.dt
        return 1.0 / (self.fps * substeps)

    @property
    def up(self) -> int:
        """Index of the axis that points up."""
        return {"Y": 1, "Z": 2}[self.up_axis]

    @property
    def gravity_vector(self) -> np.ndarray:
        """Acceleration of gravity, float64 [3], m/s^2."""
        return np.array(self.gravity) if self.gravity is not None else -9.81 * np.eye(3)[self.up]


if __name__ == "__main__":
    print(json.dumps(Scene.model_json_schema(), indent=2))
