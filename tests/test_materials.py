"""Bodies of several materials: which cell has which, and what springs and particles make of it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from reference import Key, ReferenceLattice, Vertex, build, cells_in, name_particles, springs_under
from worlds import make_material, make_scene, make_voxels

from warpjelly.errors import InputError, SceneError
from warpjelly.kernels.springs import MAX_SPAN
from warpjelly.model import build as build_model
from warpjelly.plan import plan_scene
from warpjelly.scene import Material, Scene
from warpjelly.scenefile import read_scene
from warpjelly.simulator import Simulator

SOFT = {"law": "young", "youngs_modulus": 1e4, "density": 500.0, "damping_time": 1e-3}
STIFF = {"law": "young", "youngs_modulus": 3e5, "density": 2000.0}
# All laws and both ways to give a mass; the bodies below have all of them or some.
MATERIALS: dict[str, dict[str, Any]] = {
    "soft": SOFT,
    "stiff": STIFF,
    "hooke": {
        "law": "hooke",
        "particle_mass": 0.03,
        "structural": {"stiffness": 300.0, "damping": 0.3},
        "shear": {"stiffness": 500.0, "damping": 0.7},
        "bend": {"stiffness": 70.0, "damping": 0.1},
    },
    "strain": {**make_material(90.0, 0.2), "density": 300.0},
}
NAMES = list(MATERIALS)
# Edge of a unit cell, m; a power of two, which puts particles exactly where they are counted.
UNIT = 0.25


def make_body(numbers: np.ndarray, names: list[str], per_edge: int = 2) -> dict[str, Any]:
    """Return a body of voxels in which cells with the number n > 0 are of the material names[n - 1]."""
    regions = [{"symbol": "abcdefgh"[n], "material": name} for n, name in enumerate(names[1:]) if n + 2 in numbers]
    size = UNIT * (per_edge - 1)
    return make_voxels(numbers, cell_size=size, particles_per_edge=per_edge, material=names[0], regions=regions)


def contribution(material: Material, kind: int, counts: list[int], totals: list[int], bends: int) -> np.ndarray:
    """Return stiffness [N/m] and damping [N s/m] that the cells of a material, of edge UNIT, give to a spring.

    Args:
        material: of these cells.
        kind: 0 structural, 1 face shear, 2 body shear, 3 bend.
        counts: how many of the cells are of the material: of those that contain the spring or, for a bend spring, each
            of the two under it.
        totals: how many cells those are.
        bends: sum of the lesser counts of the bend springs over a structural one.
    """
    if material.law == "young":
        assert material.youngs_modulus is not None
        inside = [0.6, 0.2, 0.15, 0.05][kind] * min(counts) / [4, 2, 1, 4][kind]
        k = material.youngs_modulus * UNIT * (inside - 2 * 0.05 * bends / 4)
        return np.array([k, k * (5e-4 if material.damping_time is None else material.damping_time)])
    constants = [material.structural, material.shear, material.shear, material.bend][kind]
    per_length = 1 / (UNIT * [1, 2**0.5, 3**0.5, 2][kind]) if material.law == "strain" else 1.0
    return np.array([constants.stiffness, constants.damping]) * per_length * sum(counts) / sum(totals)


def expected_springs(
    lattice: ReferenceLattice, name_of: dict[Vertex, str], materials: dict[str, Material]
) -> dict[frozenset[Key], np.ndarray]:
    """Return stiffness and damping of each spring, from the names of the materials of the unit cells."""

    def count(springs: list[frozenset[Key]], name: str) -> list[int]:
        return [sum(name_of[cell] == name for cell in cells_in(spring)) for spring in springs]

    under = springs_under(lattice)
    over: dict[frozenset[Key], list[list[frozenset[Key]]]] = {}
    for pair in under.values():
        for spring in pair:
            over.setdefault(spring, []).append(pair)
    expected = {}
    for ends, kind in lattice.springs.items():
        springs = under.get(ends, [ends])
        totals = [len(cells_in(spring)) for spring in springs]
        expected[ends] = np.zeros(2)
        for name in set(name_of.values()):
            bends = sum(min(count(pair, name)) for pair in over.get(ends, []))
            expected[ends] += contribution(materials[name], kind, count(springs, name), totals, bends)
    return expected


def draw(seed: int, count: int, shape: tuple[int, int, int]) -> np.ndarray:
    """Return random cells of so many materials, sparse to solid, int [shape]; 0 where there is none."""
    rng = np.random.default_rng(seed)
    numbers = rng.integers(1, count + 1, shape) * (rng.random(shape) < (0.4, 0.7, 0.9, 1.0)[seed])
    numbers[0, 0, 0], numbers[-1, -1, -1] = 1, 2
    return numbers


@pytest.mark.parametrize(("per_edge", "shape"), [(2, (3, 3, 4)), (3, (2, 2, 3))])
@pytest.mark.parametrize("names", [["soft", "stiff"], ["hooke", "strain", "hooke"], NAMES, NAMES[::-1] * 2])
@pytest.mark.parametrize("seed", range(4))
def test_random_bodies_match_the_reference(
    seed: int, names: list[str], per_edge: int, shape: tuple[int, int, int]
) -> None:
    """Build random grids of random materials, and compare every spring and every mass with the dictionaries."""
    numbers = draw(seed, len(names), shape)
    scene = make_scene(materials=MATERIALS, bodies=[make_body(numbers, names, per_edge)])
    lattice = plan_scene(scene).bodies[0].build()
    model = Simulator(scene, device="cpu").model
    refined = np.kron(numbers, np.ones([per_edge - 1] * 3, int))
    name_of = {(int(x), int(y), int(z)): names[refined[x, y, z] - 1] for x, y, z in np.argwhere(refined)}
    vertices = (lattice.particles / UNIT + np.array(refined.shape) / 2).astype(int)
    ends, rows = lattice.springs()
    keys = name_particles(vertices, ends, lattice.classes.kinds[rows])
    reference = build(numbers > 0, per_edge)
    assert keys == reference.keys
    springs = [frozenset((keys[i], keys[j])) for i, j in ends]
    assert Counter(springs) == Counter(reference.springs.keys())
    expected = expected_springs(reference, name_of, scene.materials)
    # Sums of at most eight terms, of which structural ones lose two thirds to bend springs at most.
    constants = model.spring_classes.numpy()[rows, 1:]
    np.testing.assert_allclose(constants, [expected[spring] for spring in springs], rtol=1e-14)
    given = {name: (material.density or 0, material.particle_mass or 0) for name, material in scene.materials.items()}
    masses = [
        sum(given[name_of[cell]][0] * UNIT**3 / 8 + given[name_of[cell]][1] / len(key[1]) for cell in key[1])
        for key in keys
    ]
    np.testing.assert_allclose(model.particle_mass.numpy(), masses, rtol=1e-14)


def test_springs_along_an_interface_are_in_runs() -> None:
    """Join two slabs of different materials, and find hardly more spans than those of one material."""
    numbers = np.ones((4, 3, 2 * MAX_SPAN), int)
    halves = numbers.copy()
    halves[2:] = 2
    bodies = [make_body(numbers, ["hooke"]), make_body(halves, ["hooke", "strain"])]
    plain, mixed = (plan_scene(make_scene(materials=MATERIALS, bodies=[body])).bodies[0].build() for body in bodies)
    # At the ends of the interface fewer cells are around a spring: that ends its run.
    assert mixed.spring_count == plain.spring_count
    assert len(plain.spans) < len(mixed.spans) < 1.05 * len(plain.spans)


def test_masses_add_up_to_those_of_the_cells() -> None:
    """Sum density times volume over the cells of three materials."""
    materials = {name: {"density": density} for name, density in (("a", 500.0), ("b", 70.0), ("c", 8000.0))}
    numbers = draw(2, 3, (5, 4, 6))
    simulator = Simulator(
        make_scene(materials=materials, bodies=[make_body(numbers, ["a", "b", "c"], 3)]), device="cpu"
    )
    cells = np.bincount(numbers.ravel(), minlength=4)[1:]
    expected = cells @ [500.0, 70.0, 8000.0] * (2 * UNIT) ** 3
    np.testing.assert_allclose(simulator.masses.sum(), expected, rtol=1e-14)


@pytest.mark.parametrize("name", MATERIALS)
def test_a_region_of_everything_is_a_body_of_its_material(name: str) -> None:
    """Cover a body with a region, and find the very arrays of a body of that material."""
    numbers = draw(1, 1, (4, 3, 5)) > 0
    plain = {**make_voxels(numbers), "material": name}
    covered = {**make_voxels(2 * numbers), "material": "soft", "regions": [{"symbol": "a", "material": name}]}
    models = [
        build_model(plan_scene(make_scene(materials=MATERIALS, bodies=[b])), device="cpu") for b in (plain, covered)
    ]
    (one, state), (other, other_state) = models
    np.testing.assert_array_equal(state.x.numpy(), other_state.x.numpy())
    for array in ("spans", "spring_classes", "particle_mass"):
        np.testing.assert_array_equal(getattr(one, array).numpy(), getattr(other, array).numpy())


@pytest.mark.parametrize("law", ["hooke", "strain"])
def test_equal_constants_are_their_own_mean(law: str) -> None:
    """Draw cells of two materials with the same constants, and find every spring and mass as with one."""
    numbers = draw(1, 2, (4, 3, 5))
    materials = {"a": MATERIALS[law], "b": MATERIALS[law]}
    bodies = [make_body(numbers, ["a", "b"]), make_body(np.minimum(numbers, 1), ["a"])]
    mixed, plain = (Simulator(make_scene(materials=materials, bodies=[body]), device="cpu").model for body in bodies)
    # Shares of constants add up to a rounding.
    np.testing.assert_allclose(mixed.particle_mass.numpy(), plain.particle_mass.numpy(), rtol=1e-15)
    np.testing.assert_allclose(springs_of(mixed), springs_of(plain), rtol=1e-15)


def springs_of(model: Any) -> list[list[float]]:
    """Return first particle, second particle and constants of every spring of a model, sorted by particles."""
    classes = model.spring_classes.numpy().tolist()
    spans = model.spans.numpy().tolist()
    return sorted([i + k, j + k, *classes[row]] for i, j, count, row in spans for k in range(count))


def plan_body(**body: Any) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return the names of a body's materials, the material of each cell, and which cells there are."""
    plan = plan_scene(make_scene(materials=MATERIALS, bodies=[body])).bodies[0]
    cells = plan.build.args[0].dense()
    parts = [part.dense() for part in plan.build.keywords["materials"]]
    np.testing.assert_array_equal(np.sum(parts, axis=0), cells)
    return list(plan.materials), sum(number * part for number, part in enumerate(parts)), cells


def box(folder: Path, name: str, lower: list[float], upper: list[float]) -> str:
    """Write a box as a model, and return its path."""
    trimesh.creation.box(bounds=[lower, upper]).export(folder / name)
    return str(folder / name)


@pytest.mark.parametrize("size", [{}, {"scale": 0.5}, {"fit": 12.0}])
def test_a_second_model_selects_the_cells_inside(tmp_path: Path, size: dict[str, float]) -> None:
    """Put a rod into a bar, sticking out of it on three sides: its cells are those whose centres are inside."""
    bar = box(tmp_path, "bar.obj", [1.0, 0.0, 0.0], [9.0, 4.0, 4.0])
    rod = box(tmp_path, "rod.obj", [-30.0, 1.1, -2.0], [6.6, 2.9, 3.4])
    regions = [{"file": rod, "material": "stiff"}]
    names, materials, cells = plan_body(type="model", file=bar, resolution=8, material="soft", regions=regions, **size)
    assert names == ["soft", "stiff"]
    assert cells.all() and cells.shape == (8, 4, 4)
    expected = np.zeros((8, 4, 4), int)
    expected[:6, 1:3, :3] = 1
    np.testing.assert_array_equal(materials, expected)


def test_the_same_model_selects_every_cell(tmp_path: Path) -> None:
    """Take a body's own mesh for a region: not a cell is left out, also where the scale is no power of two."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.vertices += [0.3, 1.7, -2.9]
    ball.export(tmp_path / "ball.stl")
    file = str(tmp_path / "ball.stl")
    for size in ({"scale": 0.3}, {"fit": 0.7}):
        regions = [{"file": file, "material": "stiff"}]
        names, materials, _ = plan_body(type="model", file=file, resolution=9, material="soft", regions=regions, **size)
        assert names == ["stiff"] and not materials.any()


@pytest.mark.parametrize("kind", ["objects", "materials", "groups"])
@pytest.mark.parametrize("size", [{}, {"scale": 0.3}, {"fit": 7.0}])
def test_a_part_of_the_model_selects_the_cells_inside(tmp_path: Path, kind: str, size: dict[str, float]) -> None:
    """Name the bone in a model of two shells, one in the other: its cells are those whose centres are inside."""
    words = {"objects": "o", "materials": "usemtl", "groups": "g"}
    text = ""
    for number, (name, low, high) in enumerate((("flesh", (0, 0, 0), (8, 4, 4)), ("bone", (1, 1, 1), (6, 3, 3)))):
        shell = trimesh.creation.box(bounds=[low, high])
        text += f"{words[kind]} {name}\n"
        text += "".join(f"v {x} {y} {z}\n" for x, y, z in shell.vertices)
        text += "".join(f"f {a} {b} {c}\n" for a, b, c in shell.faces + 1 + 8 * number)
    (tmp_path / "creature.obj").write_text(text)
    body = {"type": "model", "file": str(tmp_path / "creature.obj"), "resolution": 8, "material": "soft", **size}
    names, materials, cells = plan_body(**body, regions=[{"part": "bone", "material": "stiff"}])
    assert cells.all() and names == ["soft", "stiff"]
    expected = np.zeros((8, 4, 4), int)
    expected[1:6, 1:3, 1:3] = 1
    np.testing.assert_array_equal(materials, expected)
    with pytest.raises(SceneError, match=r"creature.obj: no part of the model is called 'tail'.*bone"):
        plan_body(**body, regions=[{"part": "tail", "material": "stiff"}])


def test_thin_parts_of_a_region_are_kept_where_those_of_the_body_are(tmp_path: Path) -> None:
    """Put a rod thinner than a cell, through no centre, into a bar: without ``keep_thin_parts`` it has no cell."""
    bar, rod = (
        box(tmp_path, name, lower, upper)
        for name, lower, upper in (
            ("bar.obj", [0.0, 0.0, 0.0], [8.0, 4.0, 4.0]),
            ("rod.obj", [0.2, 1.6, 1.6], [7.8, 1.7, 1.7]),
        )
    )
    body = {"type": "model", "file": bar, "resolution": 8, "material": "soft"}
    regions = [{"file": rod, "material": "stiff"}]
    with pytest.raises(SceneError, match=r"bodies.model_0.regions.0.*: has no jelly cube of the body"):
        plan_body(**body, regions=regions)
    _, materials, _ = plan_body(**body, regions=regions, keep_thin_parts=True)
    expected = np.zeros((8, 4, 4), int)
    expected[:, 1, 1] = 1
    np.testing.assert_array_equal(materials, expected)


def test_a_grid_selects_cells_by_their_place(tmp_path: Path) -> None:
    """Look up the centres of a model's cells in a coarser grid elsewhere, all its numbers or one of them."""
    bar = box(tmp_path, "bar.obj", [0.0, 0.0, 0.0], [8.0, 4.0, 4.0])
    numbers = np.zeros((2, 3, 1), np.int8)
    numbers[0, 1], numbers[1, 2] = 1, 2
    # From (0.5, -1, 0.25) on, in cells of 1 m: centres of the body's, of 0.5 m, are at 0.25, 0.75, ...
    np.savez(tmp_path / "grid.npz", cells=numbers, origin=[0.5, -1.0, 0.25], cell_size=1.0)
    body = {"type": "model", "file": bar, "resolution": 8, "scale": 0.5, "material": "soft"}
    one = np.zeros((8, 4, 4), int)
    one[1:3, 0:2, 0:2] = 1
    both = one.copy()
    both[3:5, 2:4, 0:2] = 1
    for value, expected in ((None, both), (1, one)):
        region = {"grid": str(tmp_path / "grid.npz"), "material": "stiff", "value": value}
        np.testing.assert_array_equal(plan_body(**body, regions=[region])[1], expected)


def test_a_grid_without_a_place_is_the_grid_of_the_body(tmp_path: Path) -> None:
    """Select cells one by one by a grid of the same shape, and refuse one of another shape."""
    bar = box(tmp_path, "bar.obj", [3.0, 0.0, 0.0], [7.0, 2.0, 2.0])
    numbers = np.random.default_rng(0).integers(0, 3, (4, 2, 2))
    np.savez(tmp_path / "grid.npz", cells=numbers)
    region = {"grid": str(tmp_path / "grid.npz"), "material": "stiff", "value": 2}
    body = {"type": "model", "file": bar, "material": "soft", "regions": [region]}
    np.testing.assert_array_equal(plan_body(**body, resolution=4)[1], numbers == 2)
    with pytest.raises(SceneError, match=r"no origin and cell_size .* \[4, 2, 2\] .* \[8, 4, 4\]"):
        plan_body(**body, resolution=8)


def test_later_regions_win(tmp_path: Path) -> None:
    """Let regions overlap; materials that no cell is left of are none of the body's."""
    bar = box(tmp_path, "bar.obj", [0.0, 0.0, 0.0], [4.0, 2.0, 2.0])
    parts = [box(tmp_path, f"{x}.obj", [x, -1.0, -1.0], [x + 2.0, 3.0, 3.0]) for x in (0.0, 1.0, 2.0)]
    regions = [{"file": part, "material": name} for part, name in zip(parts, ("stiff", "hooke", "stiff"), strict=True)]
    body = {"type": "model", "file": bar, "resolution": 4, "material": "soft"}
    names, materials, _ = plan_body(**body, regions=regions)
    assert names == ["stiff", "hooke"]
    np.testing.assert_array_equal(materials[:, 0, 0], [0, 1, 0, 0])


def test_numbers_in_a_file_select_cells(tmp_path: Path) -> None:
    """Find the cells with a number in the file of a body of voxels, and all others of the body's material."""
    numbers = np.array([[[0, 1, 2, 3]]], np.int16)
    np.savez(tmp_path / "cells.npz", cells=numbers, cell_size=0.5)
    regions = [{"value": 3, "material": "stiff"}]
    names, materials, cells = plan_body(
        type="voxels", file=str(tmp_path / "cells.npz"), material="soft", regions=regions
    )
    assert names == ["soft", "stiff"]
    np.testing.assert_array_equal(cells, numbers > 0)
    np.testing.assert_array_equal(materials[cells], [0, 0, 1])


VOXELS = {"type": "voxels", "material": "soft", "layers": [["#o"]]}
MODEL = {"type": "model", "material": "soft", "file": "bar.obj", "resolution": 4}


@pytest.mark.parametrize(
    ("body", "regions", "said"),
    [
        (VOXELS, [], ["bodies.0.layers", "layer 0 has 'o'", "symbol of one of its regions"]),
        (VOXELS, [{"symbol": "o"}], ["bodies.0.regions.0.material: missing"]),
        (VOXELS, [{"material": "stiff"}], ["bodies.0.regions.0: give one of symbol, value"]),
        (VOXELS, [{"material": "stiff", "symbol": "o", "value": 2}], ["regions.0: give one of symbol, value"]),
        (VOXELS, [{"material": "stiff", "value": 2}], ["regions.0: give symbol, which goes with layers"]),
        (VOXELS, [{"material": "stiff", "symbol": "oo"}], ['symbol = "oo"', "must be one character, and not # or ."]),
        (VOXELS, [{"material": "stiff", "symbol": "#"}], ['symbol = "#"', "and not # or ."]),
        (VOXELS, [{"material": "gum", "symbol": "o"}], ['bodies.0.regions.0.material = "gum"', "materials of this"]),
        (VOXELS, [{"material": "stiff", "symbol": "o", "file": "x"}], ["bodies.0.regions.0.file: unknown key"]),
        (VOXELS, {"symbol": "o"}, ["headed [[bodies.regions]]"]),
        (
            {**VOXELS, "layers": [["##"]]},
            [{"material": "stiff", "symbol": "o"}],
            ["bodies.voxels_0.regions.0.symbol = o: has no jelly cube of the body"],
        ),
        (MODEL, [{"material": "stiff"}], ["bodies.0.regions.0: give one of file, part, grid"]),
        (MODEL, [{"material": "stiff", "file": "bar.obj", "part": "a"}], ["regions.0: give one of file, part, grid"]),
        (MODEL, [{"material": "stiff", "file": "no.obj"}], ["bodies.0.regions.0.file", "no such file"]),
        (MODEL, [{"material": "stiff", "file": "bar.obj", "prim": "/a"}], ["regions.0.prim", "only USD files"]),
        (MODEL, [{"material": "stiff", "file": "bar.obj", "value": 2}], ["regions.0.value", "goes with grid alone"]),
        (MODEL, [{"material": "stiff", "grid": "bar.obj"}], ["bodies.0.regions.0: ", "bar.obj: not a grid of voxels"]),
        (MODEL, [{"material": "stiff", "file": "far.obj"}], ["far.obj", "cells long", "in the same units?"]),
        (
            MODEL,
            [{"material": "stiff", "file": "bar.obj"}, {"material": "stiff", "file": "beside.obj"}],
            ["bodies.model_0.regions.1.file = ", "beside.obj: has no jelly cube of the body"],
        ),
        ({"type": "cube", "material": "soft"}, [{"material": "stiff"}], ["bodies.0.regions", "unknown key"]),
    ],
)
def test_a_bad_region_is_refused(tmp_path: Path, body: dict[str, Any], regions: Any, said: list[str]) -> None:
    """Require the key and what is allowed in each refusal."""
    box(tmp_path, "bar.obj", [0.0, 0.0, 0.0], [4.0, 2.0, 2.0])
    box(tmp_path, "beside.obj", [0.0, 2.0, 0.0], [4.0, 3.0, 2.0])
    box(tmp_path, "far.obj", [0.0, 0.0, 0.0], [6000.0, 2000.0, 2000.0])
    with pytest.raises(InputError) as caught:
        plan_scene(read_scene({"materials": MATERIALS, "bodies": [{**body, "regions": regions}]}, tmp_path / "s.toml"))
    for part in said:
        assert part in str(caught.value)


def test_more_materials_than_a_body_can_have_are_refused() -> None:
    """Draw a body of nine materials."""
    materials = {f"m{number}": {} for number in range(9)}
    numbers = np.arange(1, 10).reshape(3, 3, 1)
    scene = make_scene(materials=materials, bodies=[make_body(numbers, list(materials))])
    with pytest.raises(SceneError, match="has 9 materials; a body can have 8"):
        plan_scene(scene)


def test_a_resolved_scene_has_its_regions(tmp_path: Path) -> None:
    """Write a scene as run.json does and read it again: the same regions."""
    box(tmp_path, "bar.obj", [0.0, 0.0, 0.0], [4.0, 2.0, 2.0])
    bodies = [
        {**MODEL, "regions": [{"material": "stiff", "file": "bar.obj"}]},
        {**VOXELS, "regions": [{"material": "stiff", "symbol": "o"}]},
    ]
    scene = read_scene({"materials": MATERIALS, "bodies": bodies}, tmp_path / "scene.toml")
    assert Scene.model_validate(scene.model_dump(mode="json", exclude_none=True)) == scene
