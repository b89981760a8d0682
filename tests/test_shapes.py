"""What is shown of a body: points that hang on its particles, in place at rest and true to any motion."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from pxr import Usd, UsdGeom, UsdShade
from worlds import make_scene

from warpjelly.cells import Cells
from warpjelly.colors import KIND_COLORS
from warpjelly.embedding import containing_cells, embed, face_cells
from warpjelly.lattice import Lattice, build_lattice
from warpjelly.plan import plan_scene
from warpjelly.polygons import Part, from_polygons
from warpjelly.previews.preview import render_preview
from warpjelly.run import simulate
from warpjelly.scene import Output
from warpjelly.shading import shared_normals
from warpjelly.shapes import Shape, at_rest, face_edges, shapes_of
from warpjelly.simulator import Simulator
from warpjelly.stage.stagefiles import open_stage
from warpjelly.stage.validate import stage_problems

ORIGIN, CELL = np.array([-1.0, 0.5, 2.0]), 0.25


def random_lattice(seed: int, particles_per_edge: int = 2) -> tuple[np.ndarray, Lattice]:
    """Return occupied unit cells and the lattice of them."""
    cells = np.random.default_rng(seed).random((4, 5, 3)) < 0.4
    lattice = build_lattice(Cells.of(cells), origin=ORIGIN, cell_size=CELL, particles_per_edge=particles_per_edge)
    for axis in range(3):
        cells = np.repeat(cells, particles_per_edge - 1, axis=axis)
    return cells, lattice


def hung(particles: np.ndarray, weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the means of the values of particles, in float64."""
    return np.einsum("pk,pkc->pc", weights.astype(float), values[particles])


def only(shapes: list[Shape], name: str) -> Shape:
    """Return the shape of that name."""
    (shape,) = [shape for shape in shapes if shape.name == name]
    return shape


@pytest.mark.parametrize("particles_per_edge", [2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_points_hang_on_the_cell_that_holds_them_or_the_nearest(seed: int, particles_per_edge: int) -> None:
    """Compare cells with a search through all of them, for points in, around and far away from a body."""
    cells, lattice = random_lattice(seed, particles_per_edge)
    rng = np.random.default_rng(seed)
    local = rng.uniform(-2.0, 2.0 + max(cells.shape), (400, 3))
    local[:50] = rng.uniform(-100.0, 100.0, (50, 3))
    points = ORIGIN + local * lattice.unit
    found = containing_cells(lattice, points)
    assert cells[tuple(found.T)].all()
    occupied = np.argwhere(cells)
    away = np.linalg.norm(local[:, None] - np.clip(local[:, None], occupied, occupied + 1), axis=2)
    own = np.linalg.norm(local - np.clip(local, found, found + 1), axis=1)
    # The surface is searched in float32, up to 100 cells away.
    np.testing.assert_allclose(own, away.min(axis=1), rtol=1e-6, atol=1e-5)
    assert (away.min(axis=1) == 0).any() and (away.min(axis=1) > 1).any()


@pytest.mark.parametrize("particles_per_edge", [2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_embedded_points_follow_every_affine_motion(seed: int, particles_per_edge: int) -> None:
    """Find each point where an affine map takes it, inside of its cell and outside; trilinear inside."""
    _, lattice = random_lattice(seed, particles_per_edge)
    rng = np.random.default_rng(seed)
    points = ORIGIN + rng.uniform(-1.0, 6.0, (300, 3)) * lattice.unit
    cells = containing_cells(lattice, points)
    particles, weights = embed(lattice, points, cells)
    # Each weight is rounded once, and none is larger than the distance from the cell, here below 30 cells.
    np.testing.assert_allclose(weights.sum(axis=1, dtype=float), 1.0, rtol=0, atol=8 * 30 * 2**-24)
    matrix, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
    moved = hung(particles, weights, lattice.particles @ matrix.T + shift)
    np.testing.assert_allclose(moved, points @ matrix.T + shift, rtol=0, atol=1e-4)
    # A function of the corner that is linear along each axis alone has its own value inside.
    local = lattice.grid_coordinates(points)
    inside = ((local >= cells) & (local <= cells + 1)).all(axis=1)
    assert inside.any()
    product = lattice.grid_coordinates(lattice.particles).prod(axis=1)[:, None]
    np.testing.assert_allclose(
        hung(particles, weights, product)[inside, 0], local[inside].prod(axis=1), rtol=0, atol=8 * 2000 * 2**-24
    )


def test_far_points_are_carried_on_straight() -> None:
    """Continue the motion of the nearest point of the cell linearly, not with the products of trilinear weights."""
    lattice = build_lattice(Cells.of(np.ones((1, 1, 1), bool)), origin=np.zeros(3), cell_size=1.0)
    point = np.array([[11.0, 11.0, 11.0]])
    particles, weights = embed(lattice, point, np.zeros((1, 3), np.int32))
    # One corner lifted by d lifts the nearest point by d, and each axis adds its slope d times the 10 cells.
    lifted = np.zeros((8, 1))
    lifted[7] = 1.0
    assert hung(particles, weights, lifted)[0, 0] == pytest.approx(31.0, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_blocky_surfaces_split_where_directions_meet(seed: int) -> None:
    """Share points within a direction, between cells that share particles, and nowhere else."""
    _, lattice = random_lattice(seed)
    shape = only(shapes_of("body", lattice, Output()), "surface")
    quads = shape.corners.reshape(-1, 4)
    particles = shape.particles[:, 0][quads]
    np.testing.assert_array_equal(particles, lattice.surface_particles[lattice.surface_quads])
    at = lattice.particles[particles]
    outward = np.cross(at[:, 2] - at[:, 0], at[:, 3] - at[:, 1])
    direction = np.rint(outward / np.linalg.norm(outward, axis=1)[:, None]).astype(int)
    keys = {}
    for corner, particle, normal in zip(quads.ravel(), particles.ravel(), np.repeat(direction, 4, axis=0), strict=True):
        keys.setdefault(int(corner), set()).add((int(particle), *normal.tolist()))
    assert all(len(key) == 1 for key in keys.values())
    assert len(keys) == len({key.pop() for key in keys.values()}) == len(shape.particles)


def test_a_blocky_cube_has_flat_faces_and_hard_edges() -> None:
    """Give the points of a cube at rest the normals of its six faces."""
    scene = make_scene(bodies=[{"type": "cube", "name": "cube", "material": "jelly", "particles_per_edge": 4}])
    (sample,) = Simulator(scene, device="cpu").shapes()
    assert Counter(map(tuple, (sample.normals + 0.0).tolist())) == Counter(
        {tuple(sign * float(axis == k) + 0.0 for k in range(3)): 16 for axis in range(3) for sign in (-1.0, 1.0)}
    )


def sphere_cells(radius: int) -> np.ndarray:
    """Return the cells of a ball, bool [2 radius, ...]."""
    centers = np.arange(2 * radius) + 0.5 - radius
    x, y, z = np.meshgrid(centers, centers, centers, indexing="ij")
    return x**2 + y**2 + z**2 < radius**2


def test_smooth_surfaces_lose_the_steps_but_not_the_volume() -> None:
    """Compare the surface of a ball of cells with the ball: normals, volume, and how far it is from round."""
    radius = 8
    lattice = build_lattice(Cells.of(sphere_cells(radius)), origin=np.full(3, -8.0), cell_size=1.0)
    meshes = {}
    for surface in ("voxels", "smooth"):
        shape = only(shapes_of("ball", lattice, Output(surface=surface)), "surface")
        points = hung(shape.particles, shape.weights, lattice.particles)
        quads = shape.corners.reshape(-1, 4)
        meshes[surface] = trimesh.Trimesh(points, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), process=False)
    smooth, blocky = meshes["smooth"], meshes["voxels"]
    assert smooth.is_watertight and smooth.is_winding_consistent
    # The filter keeps what is long against a cell to some percent.
    assert smooth.volume == pytest.approx(blocky.volume, rel=0.05)
    spread = {name: np.linalg.norm(mesh.vertices, axis=1).std() for name, mesh in meshes.items()}
    assert spread["smooth"] < spread["voxels"] / 2
    angles = {}
    for name, mesh in meshes.items():
        middles = mesh.triangles_center / np.linalg.norm(mesh.triangles_center, axis=1)[:, None]
        angles[name] = np.degrees(np.arccos(np.clip((mesh.face_normals * middles).sum(axis=1), -1, 1))).mean()
    assert angles["smooth"] < angles["voxels"] / 3


def test_smooth_surfaces_of_cells_that_only_touch_stay_apart() -> None:
    """Hang each point on particles of its own cells, be the other cell ever so near."""
    cells = np.zeros((2, 2, 1), bool)
    cells[0, 0] = cells[1, 1] = True
    lattice = build_lattice(Cells.of(cells), origin=np.zeros(3), cell_size=1.0)
    shape = only(shapes_of("two", lattice, Output(surface="smooth")), "surface")
    for point, particle in enumerate(lattice.surface_particles):
        assert particle in shape.particles[point]
    ours = lattice.particles[:, 0] < 1.0
    for quad in shape.corners.reshape(-1, 4):
        sides = {bool(np.mean(lattice.particles[shape.particles[point]], axis=0)[0] < 1.0) for point in quad}
        assert len(sides) == 1
    assert ours.any()


def test_smooth_surfaces_hang_on_their_own_body() -> None:
    """Round a hollow corner of four cells, in which the cell of another body touches them."""
    cells = np.zeros((2, 2, 2), bool)
    for cell in [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)]:
        cells[cell] = True
    lattice = build_lattice(Cells.of(cells), origin=np.zeros(3), cell_size=1.0, particles_per_edge=3)
    shape = only(shapes_of("two", lattice, Output(surface="smooth")), "surface")
    body = np.arange(len(lattice.particles))
    for _ in body:
        for one, other in lattice.springs()[0]:
            body[[one, other]] = min(body[one], body[other])
    assert len(np.unique(body)) == 2
    points = hung(shape.particles, shape.weights, lattice.particles)
    assert ((points > 1.0).all(axis=1) & (body[lattice.surface_particles] == 0)).any()
    own = np.broadcast_to(body[lattice.surface_particles][:, None], shape.particles.shape)
    np.testing.assert_array_equal(body[shape.particles], own)


def test_smooth_surfaces_hang_on_the_nearest_of_their_cells() -> None:
    """Compare how far points are from the cells that they hang on with all cells that have a face at them."""
    lattice = build_lattice(Cells.of(sphere_cells(4)), origin=np.full(3, -4.0), cell_size=1.0)
    shape = only(shapes_of("ball", lattice, Output(surface="smooth")), "surface")
    points = hung(shape.particles, shape.weights, lattice.particles)

    def away(points: np.ndarray, centers: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.maximum(np.abs(points - centers) - 0.5, 0.0), axis=1)

    least = np.full(len(points), np.inf)
    centers = np.repeat(face_cells(lattice) - 3.5, 4, axis=0)
    np.minimum.at(least, shape.corners, away(points[shape.corners], centers))
    assert least.max() > 0.1
    # Coordinates below 4, with weights in float32.
    np.testing.assert_allclose(away(points, lattice.particles[shape.particles].mean(axis=1)), least, rtol=0, atol=1e-5)


def test_points_have_the_means_of_velocities_and_forces(tmp_path: Path) -> None:
    """Move every particle of a model differently: vertices have the weighted means, and forces no less than 0."""
    write_ball(tmp_path / "ball.ply")
    simulator = Simulator(model_scene(tmp_path / "ball.ply"), device="cpu")
    state, rng = simulator.state, np.random.default_rng(0)
    v, f = rng.normal(size=(2, 3, simulator.model.particle_count))
    # Forces of one in ten particles alone, so that points outside of their cells would have negative ones.
    f *= 1000.0 * (rng.random(f.shape[1]) < 0.1)
    state.v.assign(v)
    state.f.assign(f)
    (shape,), (sample,) = simulator.model.shapes, simulator.shapes()
    np.testing.assert_allclose(sample.velocities, hung(shape.particles, shape.weights, v.T), rtol=0, atol=1e-5)
    forces = hung(shape.particles, shape.weights, np.linalg.norm(f, axis=0)[:, None])[:, 0]
    assert forces.min() < -1.0
    # Sums of eight terms of up to some thousand, each rounded to float32.
    np.testing.assert_allclose(sample.forces, np.maximum(forces, 0.0), rtol=0, atol=8 * 5000 * 2**-24)


@pytest.mark.parametrize("surface", ["voxels", "smooth"])
def test_a_shape_at_rest_is_what_a_simulator_shows_at_first(surface: str) -> None:
    """Compare the sample in the body's frame with that of a simulator, for a body that is put nowhere else."""
    layers = [["##.", "#.#"], ["#..", "#.#"]]
    body = {"type": "voxels", "name": "body", "material": "jelly", "layers": layers}
    show = ["surface", "springs", "particles"]
    scene = make_scene(bodies=[body], output={"surface": surface, "show": show})
    (plan,) = plan_scene(scene).bodies
    lattice = plan.build()
    shapes = shapes_of("body", lattice, scene.output)
    assert [shape.name for shape in shapes] == show
    for shape, sample in zip(shapes, Simulator(scene, device="cpu").shapes(), strict=True):
        rest = at_rest(shape, lattice)
        # Coordinates below 0.2 m, in float32, and normals from differences of such, 0.1 m apart.
        np.testing.assert_allclose(rest.points, sample.points, rtol=0, atol=1e-7)
        np.testing.assert_allclose(rest.normals, sample.normals, rtol=0, atol=1e-5)


def test_faces_know_their_cells() -> None:
    """Find the occupied cell behind every face."""
    cells, lattice = random_lattice(5)
    assert cells[tuple(face_cells(lattice).T)].all()


def write_ball(path: Path) -> trimesh.Trimesh:
    """Write a model that is curved and far from its own origin."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    mesh.apply_translation([3.0, 1.0, -2.0])
    mesh.export(path)
    return mesh


def model_scene(path: Path, **output: Any) -> Any:
    """Return a scene of one model."""
    body = {"type": "model", "name": "ball", "material": "jelly", "file": str(path), "resolution": 5}
    return make_scene(
        bodies=[body], output={"surface": "model", **output}, frames=3, gravity=[0.0, -9.81, 0.0], solver={"dt": 5e-4}
    )


def test_an_embedded_model_at_rest_is_the_original(tmp_path: Path, precision: str) -> None:
    """Compare the rest pose with the file: the same polygons, every vertex within 1e-6 of the size."""
    mesh = write_ball(tmp_path / "ball.ply")
    scene = model_scene(tmp_path / "ball.ply").model_copy(
        update={"solver": make_scene(solver={"precision": precision}).solver}
    )
    simulator = Simulator(scene, device="cpu")
    (shape,), (sample,) = simulator.model.shapes, simulator.shapes()
    assert (shape.counts == 3).all()
    np.testing.assert_array_equal(shape.corners.reshape(-1, 3), mesh.faces)
    # The model is 1 m large and 4 m away, where float32 is exact to 2.4e-7 m.
    np.testing.assert_allclose(sample.points, mesh.vertices, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("keys", "factor"), [({"scale": 0.25}, 0.25), ({"fit": 3.0}, 3.0)])
def test_a_model_is_drawn_as_large_as_its_lattice(tmp_path: Path, keys: dict[str, float], factor: float) -> None:
    """Scale a model of 1 m: every vertex is where it was, times the factor."""
    mesh = write_ball(tmp_path / "ball.ply")
    body = {"type": "model", "material": "jelly", "file": str(tmp_path / "ball.ply"), "resolution": 5, **keys}
    plan = plan_scene(make_scene(bodies=[body], output={"surface": "model"})).bodies[0]
    lattice = plan.build()
    (shape,) = shapes_of("ball", lattice, Output(surface="model"), plan.model)
    assert np.ptp(lattice.particles, axis=0).max() == pytest.approx(factor, rel=1e-6)
    # Up to 12 m away in float32, from a file in float32 that makes the ball 1 m large but for its rounding.
    np.testing.assert_allclose(at_rest(shape, lattice).points, mesh.vertices * factor, rtol=0, atol=3e-6)


def write_painted_box(folder: Path) -> Path:
    """Write a box of quads with UVs, half of it textured, half of one colour, and the rest without a material."""
    Image.new("RGB", (4, 4), (255, 0, 0)).save(folder / "red.png")
    (folder / "box.mtl").write_text("newmtl painted\nmap_Kd red.png\nnewmtl green wood\nKd 0.0 0.5 0.0\n")
    vertices = [f"v {x} {y} {z}" for x, y, z in BOX]
    uvs = [f"vt {u} {v}" for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))]
    looks = ["usemtl painted", "", "usemtl green wood", "", "usemtl unknown", ""]
    faces = []
    for look, quad in zip(looks, BOX_QUADS, strict=True):
        faces += [look, "f " + " ".join(f"{corner + 1}/{k + 1}" for k, corner in enumerate(quad))]
    (folder / "box.obj").write_text("\n".join(["mtllib box.mtl", *vertices, *uvs, *faces]) + "\n")
    return folder / "box.obj"


@pytest.mark.parametrize("look", ["model", "force"])
def test_a_stage_has_the_uvs_and_materials_of_the_model(tmp_path: Path, look: str) -> None:
    """Write polygons, UVs and materials as the file has them, textures beside the stage; or colours of forces."""
    model = write_painted_box(tmp_path)
    simulate(model_scene(model, look=look), output=tmp_path / "run", device="cpu")
    assert stage_problems(tmp_path / "run") == []
    stage = open_stage(tmp_path / "run")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/bodies/ball/surface"))
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [4] * 6
    np.testing.assert_array_equal(mesh.GetFaceVertexIndicesAttr().Get(), np.ravel(BOX_QUADS))
    np.testing.assert_allclose(mesh.GetPointsAttr().Get(), BOX, rtol=0, atol=1e-6)
    uvs = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
    np.testing.assert_array_equal(uvs, [[0, 0], [1, 0], [1, 1], [0, 1]] * 6)
    subsets = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
    if look == "force":
        assert not subsets and not (tmp_path / "run" / "textures").exists()
        return
    assert [list(subset.GetIndicesAttr().Get()) for subset in subsets] == [[0, 1], [2, 3]]
    shaders = []
    for subset in subsets:
        material = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0]
        shaders.append(material.ComputeSurfaceSource()[0])
    np.testing.assert_allclose(shaders[1].GetInput("diffuseColor").Get(), [0.0, 0.5, 0.0])
    texture = UsdShade.Shader(shaders[0].GetInput("diffuseColor").GetConnectedSources()[0][0].source.GetPrim())
    asset = texture.GetInput("file").Get()
    assert asset.path == "./textures/red.png"
    assert Path(asset.resolvedPath).read_bytes() == (tmp_path / "red.png").read_bytes()
    # What has no material shows forces, as all of it does for readers that know none.
    assert UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0].GetPath() == "/World/looks/jelly"
    assert mesh.GetDisplayColorPrimvar().ValueMightBeTimeVarying()
    # A stage without its texture is found out.
    (tmp_path / "run" / "textures" / "red.png").unlink()
    (problem,) = stage_problems(tmp_path / "run")
    assert "textures/red.png" in problem


def test_pieces_that_are_dropped_are_not_shown(tmp_path: Path) -> None:
    """Keep of two balls the larger one alone, and with it the crumb that touches its cells."""
    balls = [trimesh.creation.icosphere(subdivisions=2, radius=radius) for radius in (0.5, 0.3, 0.02)]
    balls[1].apply_translation([3.0, 0.0, 0.0])
    balls[2].apply_translation([0.0, 0.55, 0.0])
    trimesh.util.concatenate(balls).export(tmp_path / "balls.ply")
    shown = {}
    for pieces in ("all", "largest"):
        scene = model_scene(tmp_path / "balls.ply")
        body = scene.bodies[0].model_copy(update={"resolution": 20, "pieces": pieces})
        (shape,), (sample,) = (
            (simulator := Simulator(scene.model_copy(update={"bodies": [body]}), device="cpu")).model.shapes,
            simulator.shapes(),
        )
        assert shape.corners.max() < len(sample.points)
        shown[pieces] = sample.points
    assert len(shown["all"]) == sum(len(ball.vertices) for ball in balls)
    assert len(shown["largest"]) == len(balls[0].vertices) + len(balls[2].vertices)
    assert shown["largest"][:, 0].max() < 0.6 < shown["all"][:, 0].max()


def test_edges_of_faces_are_those_of_squares() -> None:
    """Count the edges of the faces of two cubes side by side, each once: 20 of 12 vertices."""
    lattice = build_lattice(Cells.of(np.ones((2, 1, 1), bool)), origin=np.zeros(3), cell_size=1.0)
    shape = face_edges("two", lattice)
    ends = lattice.particles[shape.particles[:, 0]].reshape(-1, 2, 3)
    assert len(ends) == 20
    np.testing.assert_allclose(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), 1.0)


@pytest.mark.egl
def test_textures_are_shown_the_right_way_up(tmp_path: Path) -> None:
    """Find the upper half of an image at the top, where v is 1."""
    model = write_painted_box(tmp_path)
    image = Image.new("RGB", (8, 8), (0, 0, 255))
    image.paste((255, 0, 0), (0, 0, 8, 4))
    image.save(tmp_path / "red.png")
    lines = model.read_text().splitlines()
    # Every side gets the image, v along y.
    faces = [
        "1/1 2/1 4/4 3/4",
        "5/1 7/4 8/4 6/1",
        "1/1 5/1 6/1 2/1",
        "3/4 4/4 8/4 7/4",
        "1/1 3/4 7/4 5/1",
        "2/1 6/1 8/4 4/4",
    ]
    kept = [line for line in lines if not line.startswith(("f ", "usemtl")) and line]
    model.write_text("\n".join([*kept, "usemtl painted", *(f"f {face}" for face in faces)]) + "\n")
    simulate(model_scene(model), output=tmp_path / "run", device="cpu")
    render_preview(tmp_path / "run", tmp_path / "p.png", frames=[0], size=(320, 240))
    with Image.open(tmp_path / "p.png") as picture:
        red, _, blue = np.moveaxis(np.asarray(picture.convert("RGB")).astype(int), 2, 0)
    reds, blues = np.argwhere((red > 90) & (blue < red / 3)), np.argwhere((blue > 90) & (red < blue / 3))
    assert len(reds) > 100 and len(blues) > 100
    assert reds[:, 0].mean() < blues[:, 0].mean()


@pytest.mark.egl
def test_springs_over_a_floor_are_drawn_in_bounded_memory(tmp_path: Path) -> None:
    """Throw shadows of thousands of springs with a limited number of points."""
    body = {"type": "cube", "name": "cube", "material": "jelly", "particles_per_edge": 8, "position": [0.0, 1.0, 0.0]}
    floor = {"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [4.0, 4.0]}
    scene = make_scene(bodies=[body], colliders=[floor], output={"show": ["springs"]}, frames=1)
    simulate(scene, output=tmp_path / "run", device="cpu")
    script = (
        "import resource, sys; from pathlib import Path; from warpjelly.previews.preview import render_preview\n"
        "render_preview(Path(sys.argv[1]), Path(sys.argv[2]), size=(320, 180))\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "run"), str(tmp_path / "p.png")]
    process = subprocess.run(command, check=True, capture_output=True, text=True)
    # It takes about 0.6 GB, and took more than 20 GB where long thin triangles were filled like large ones.
    assert int(process.stdout) < 2_000_000


@pytest.mark.egl
def test_a_picture_shows_the_materials_of_the_model(tmp_path: Path) -> None:
    """Find the red of the texture and the green of the material in the picture."""
    simulate(model_scene(write_painted_box(tmp_path)), output=tmp_path / "run", device="cpu")
    render_preview(tmp_path / "run", tmp_path / "p.png", frames=[0], size=(320, 240))
    with Image.open(tmp_path / "p.png") as picture:
        red, green, blue = np.asarray(picture.convert("RGB")).astype(int).reshape(-1, 3).T
    assert ((red > 100) & (green < red / 3) & (blue < red / 3)).any()
    assert ((green > 60) & (red < green / 2) & (blue < green / 2)).any()


def test_an_embedded_model_goes_where_its_lattice_goes(tmp_path: Path) -> None:
    """Let a model fall freely: every vertex falls by the same distance."""
    write_ball(tmp_path / "ball.ply")
    simulator = Simulator(model_scene(tmp_path / "ball.ply"), device="cpu")
    before = simulator.shapes()[0]
    simulator.advance_frame()
    after = simulator.shapes()[0]
    steps, dt = simulator.substeps, simulator.dt
    drop = -9.81 * dt**2 * steps * (steps + 1) / 2
    # Float32 coordinates of up to 4 m, rounded in each substep.
    np.testing.assert_allclose(after.points - before.points, np.tile([0, drop, 0], (len(before.points), 1)), atol=1e-5)
    np.testing.assert_allclose(after.velocities[:, 1], -9.81 * dt * steps, rtol=1e-5)
    np.testing.assert_allclose(after.normals, before.normals, rtol=0, atol=1e-3)


def test_the_stage_of_an_embedded_model_is_sound(tmp_path: Path) -> None:
    """Write its own polygons, and normals that corners share, at rest and at every frame."""
    write_ball(tmp_path / "ball.obj")
    simulate(model_scene(tmp_path / "ball.obj", velocities=True), output=tmp_path / "run", device="cpu")
    assert stage_problems(tmp_path / "run") == []
    stage = open_stage(tmp_path / "run")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/bodies/ball/surface"))
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    normals = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    for time in (Usd.TimeCode.Default(), 0, 2):
        at = np.array(mesh.GetPointsAttr().Get(time))[list(mesh.GetFaceVertexIndicesAttr().Get())]
        shown = np.array(normals.ComputeFlattened(time))
        outward = at - np.array(mesh.GetPointsAttr().Get(time)).mean(axis=0)
        cosines = (shown * outward).sum(axis=1) / np.linalg.norm(outward, axis=1)
        assert cosines.min() > 0.99


def test_springs_and_particles_are_shown_where_asked(tmp_path: Path) -> None:
    """Write springs in the colours of their kinds and particles in those of forces, beside the surface."""
    output = {"show": ["surface", "springs", "particles"], "spring_colors": "kind"}
    body = {"type": "cube", "name": "cube", "material": "jelly", "particles_per_edge": 3}
    scene = make_scene(bodies=[body], output=output, frames=2)
    simulate(scene, output=tmp_path, device="cpu")
    assert stage_problems(tmp_path) == []
    stage = open_stage(tmp_path)
    children = stage.GetPrimAtPath("/World/bodies/cube").GetChildren()
    assert [str(prim.GetName()) for prim in children] == ["surface", "springs", "particles"]
    curves, balls = UsdGeom.BasisCurves(children[1]), UsdGeom.Points(children[2])
    simulator = Simulator(scene, device="cpu")
    for frame in range(2):
        np.testing.assert_array_equal(balls.GetPointsAttr().Get(frame), simulator.positions.astype(np.float32))
        simulator.advance_frame()
    colors = np.array(curves.GetDisplayColorPrimvar().ComputeFlattened(1))
    ends = np.array(curves.GetPointsAttr().Get()).reshape(-1, 2, 3)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / 0.5
    # Structural springs are one unit cell long, bend springs two; shear springs are diagonals.
    kind = np.select([np.isclose(lengths, 1.0), np.isclose(lengths, 2.0)], [0, 3], 1)
    np.testing.assert_allclose(colors, KIND_COLORS[kind], rtol=1e-6)
    assert Counter(kind.tolist()) == {0: 54, 1: 72 + 32, 3: 27}


BOX = np.array(list(np.ndindex(2, 2, 2)), float)
BOX_QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def box(normals: np.ndarray | None = None) -> Part:
    """Return a cube of six quads."""
    return from_polygons(BOX, np.full(6, 4), np.ravel(BOX_QUADS), normals=normals)


def test_creases_stay_hard_and_the_rest_smooth() -> None:
    """Share normals across shallow edges and across repeated vertices, not across steep ones."""
    assert len(np.unique(shared_normals(box()))) == 24
    ball = trimesh.creation.icosphere(subdivisions=3)
    threes = np.full(len(ball.faces), 3)
    smooth = shared_normals(from_polygons(ball.vertices, threes, ball.faces.ravel()))
    assert len(np.unique(smooth)) == len(ball.vertices)
    # As formats write it that repeat vertices.
    loose = from_polygons(ball.vertices[ball.faces.ravel()], threes, np.arange(ball.faces.size))
    np.testing.assert_array_equal(shared_normals(loose), smooth)


@pytest.mark.parametrize(("sides", "is_round"), [(10, True), (8, False)])
def test_a_crease_is_where_faces_turn_by_more_than_forty_degrees(sides: int, is_round: bool) -> None:
    """Share normals round a prism whose sides turn by 36 degrees, not where they turn by 45, nor with its ends."""
    prism = trimesh.creation.cylinder(1.0, 2.0, sections=sides)
    numbers = shared_normals(from_polygons(prism.vertices, np.full(len(prism.faces), 3), prism.faces.ravel()))
    # Both ends are flat: they have a normal at each vertex. So does what is round; else each side has its own four.
    assert len(np.unique(numbers)) == len(prism.vertices) + (2 if is_round else 4) * sides


def test_a_models_own_normals_say_what_is_smooth() -> None:
    """Share a normal where the file has the same one for a vertex."""
    outward = (BOX[np.ravel(BOX_QUADS)] - 0.5) / np.sqrt(0.75)
    assert len(np.unique(shared_normals(box(outward)))) == 8
    flat = np.repeat(np.eye(3)[[0, 0, 1, 1, 2, 2]] * np.array([-1, 1, -1, 1, -1, 1])[:, None], 4, axis=0)
    assert len(np.unique(shared_normals(box(flat)))) == 24
