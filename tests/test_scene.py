import json
import math
from pathlib import Path

import numpy as np
import pytest

from warpjelly.errors import InputError
from warpjelly.scene import PlaneCollider, Scene, VoxelsBody
from warpjelly.scenefile import load_scene

SCENES = Path(__file__).parent.parent / "scenes"

MINIMAL = """
[materials.jelly]

[[bodies]]
type = "cube"
material = "jelly"

[[colliders]]
type = "sphere"
radius = 1.0
"""


@pytest.fixture
def scene_file(tmp_path):
    """Return a function that writes a scene file and gives its path."""

    def write(text: str = MINIMAL) -> Path:
        path = tmp_path / "my scene.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def nested(depth: int) -> dict:
    """Return tables in tables."""
    table: dict = {}
    for _ in range(depth):
        table = {"a": table}
    return table


def refusal(path: Path, **options) -> str:
    """Return the message with which a scene is refused."""
    with pytest.raises(InputError) as caught:
        load_scene(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_defaults_are_filled_in(scene_file):
    """Check the defaults of a scene that says only what it must."""
    scene = load_scene(scene_file())
    assert scene.name == "my_scene"
    assert scene.bodies[0].name == "cube_0"
    assert scene.bodies[0].particles_per_edge == 8
    assert scene.colliders[0].name == "sphere_0"
    assert scene.frame_count == 120
    assert scene.fps == 60.0
    np.testing.assert_array_equal(scene.gravity_vector, [0.0, -9.81, 0.0])


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"solver.dt": -1.0}, ["solver.dt = -1.0", "greater than", "time step, s"]),
        ({"solver.dt": math.nan}, ["solver.dt", "finite"]),
        ({"solver.dt": "fast"}, ['solver.dt = "fast"', "number"]),
        ({"solver.dt": True}, ["solver.dt = true", "number"]),
        ({"solver.dt": 10**400, "solver.steps_per_frame": 2}, ["solver.dt = 1000", "number"]),
        ({"solver.dt": 1e-320, "solver.steps_per_frame": 2}, ["solver.dt = 1e-320", "greater than"]),
        ({"solver.steps_per_frame": 10**400}, ["solver.steps_per_frame = 1000", "less than or equal to 1000000"]),
        # More digits than Python writes, more levels than it follows.
        ({"fps": 16**6000}, ["fps = ...", "number"]),
        ({"fps": nested(3000)}, ["fps", "number"]),
        ({"gravity": nested(3000)}, ["gravity", "list of numbers"]),
        ({"solver.precision": "half"}, ['solver.precision = "half"', "float32"]),
        ({"solver.stepp": 1}, ["solver.stepp", "unknown key", "integrator, dt, precision, culling"]),
        ({"solver.presision": 1}, ["solver.presision", "did you mean 'precision'"]),
        ({"colliders.0.radios": 1.0}, ["colliders.0.radios", "did you mean 'radius'"]),
        ({"colliders.0.radius": -2.0}, ["colliders.0.radius = -2.0", "greater than"]),
        ({"colliders.0.radius": 1e300}, ["colliders.0.radius", "less than"]),
        ({"colliders.0.type": "ball"}, ["colliders.0.type = 'ball'", "'sphere'"]),
        ({"colliders.0.stiffness": 0.0}, ["colliders.0.stiffness = 0.0", "greater than 0"]),
        ({"bodies.0.size": math.inf}, ["bodies.0.size", "finite"]),
        ({"bodies.0.particles_per_edge": 1}, ["bodies.0.particles_per_edge = 1", "2"]),
        ({"bodies.0.particles_per_edge": 8.5}, ["bodies.0.particles_per_edge = 8.5", "integer"]),
        ({"bodies.0.material": "gum"}, ['bodies.0.material = "gum"', "materials of this scene: jelly"]),
        ({"bodies.0.position": [1.0, 2.0]}, ["bodies.0.position = [1.0, 2.0]", "must have 3 entries, not 2"]),
        ({"bodies.0.position": "here"}, ['bodies.0.position = "here"']),
        ({"bodies.0.name": "my cube"}, ['bodies.0.name = "my cube"', "letters, digits and _"]),
        ({"bodies": []}, ["bodies = []", "must not be empty"]),
        ({"colliders": 3}, ["colliders = 3", "must be a list", "headed [[colliders]], with"]),
        ({"bodies.0.pinned": 3}, ["bodies.0.pinned = 3", "must be a list", "headed [[bodies.pinned]], with"]),
        ({"fields": [{"type": "constant", "force": [0, 0, 0], "curve": 3}]}, ["curve = 3: must be a list (keyframes"]),
        (
            {"contact.static_friction": 0.3},
            ["contact.dynamic_friction = 0.4: must not be above static_friction, which is 0.3"],
        ),
        ({"colliders.0.static_friction": 0.0}, ["colliders.0.dynamic_friction = 0.4", "which is 0;", "[contact]"]),
        ({"colliders.0.dynamic_friction": 0.7}, ["colliders.0.dynamic_friction = 0.7", "which is 0.6;", "[contact]"]),
        ({"materials.jelly.particle_mass": 0.0}, ["materials.jelly.particle_mass = 0.0", "greater than", "kg"]),
        ({"materials.jelly.shear.stiffness": -5.0}, ["materials.jelly.shear.stiffness = -5.0", "N/m"]),
        ({"materials.jelly.law": "rubber"}, ['materials.jelly.law = "rubber"', "'strain', 'hooke' or 'young'"]),
        ({"gravity": [0.0, math.nan, 0.0]}, ["gravity.1", "finite"]),
        ({"fps": 0.0}, ["fps = 0.0", "samples per second"]),
        ({"fps": True}, ["fps = true", "number"]),
        ({"duration": 1e9}, ["duration = 1000000000.0", "frames"]),
        ({"duration": 1.0, "frames": 10}, ["duration = 1.0", "not both"]),
        ({"frames": 0}, ["frames = 0", "1"]),
        ({"fps": 0.1, "solver.dt": 1e-9}, ["solver.dt", "substeps"]),
        ({"output.force_range": [2.0, 1.0]}, ["output.force_range = [2.0, 1.0]", "below"]),
        ({"output.force_range": "wide"}, ["output.force_range"]),
        ({"expect.rest_height.body": "dog", "expect.rest_height.min": 0.0}, ["expect.rest_height.body", "cube_0"]),
        ({"expect.rest_height": {}}, ["expect.rest_height", "min, max or both"]),
        ({"materials.jelly": {"density": 1.0, "particle_mass": 1.0}}, ["materials.jelly", "not both"]),
    ],
)
def test_a_bad_value_is_refused_in_one_line(scene_file, overrides, said):
    """Require the key, the value and what is allowed in each refusal."""
    path = scene_file()
    message = refusal(path, overrides=overrides)
    assert message.startswith(f"{path}: ")
    for part in said:
        assert part in message


@pytest.mark.parametrize(
    ("collider", "said"),
    [
        ('type = "plane"\nnormal = [0.0, 0.0, 0.0]\nsize = [1.0, 1.0]', "normal must not be zero"),
        ('type = "plane"\nnormal = [0.0, 1.0, 0.0]\ntangent = [0.0, 2.0, 0.0]\nsize = [1.0, 1.0]', "parallel"),
        ('type = "plane"\nnormal = [0.0, 1.0, 0.0]\nsize = [1.0, 0.0]', "colliders.1.size.1 = 0.0"),
        ('type = "half_space"\nnormal = [0.0, 0.0, 0.0]', "normal must not be zero"),
        ('type = "half_space"', "colliders.1.normal: missing"),
        ('type = "box"\nsize = [1.0, -1.0, 1.0]', "colliders.1.size.1 = -1.0"),
        ('type = "sphere"\nradius = 1.0\nname = "sphere_0"', "this name is taken"),
    ],
)
def test_a_degenerate_collider_is_refused(scene_file, collider, said):
    """Refuse colliders that have no direction, no size or another's name."""
    assert said in refusal(scene_file(MINIMAL + "\n[[colliders]]\n" + collider))


@pytest.mark.parametrize(
    ("layers", "said"),
    [
        ([["##"], ["#"]], "row 0 of layer 1 has 1 cells, row 0 of layer 0 has 2"),
        ([["#", "##"]], "row 1 of layer 0 has 2 cells, row 0 of layer 0 has 1"),
        ([["#"], ["#", "#"]], "layer 1 has 2 rows, layer 0 has 1"),
        ([["#x"]], "layer 0 has 'x'"),
        ([[".."]], "no jelly cube"),
        ([], "must not be empty"),
    ],
)
def test_a_bad_grid_is_refused(scene_file, layers, said):
    """Refuse voxel grids that are ragged, empty or drawn with other characters."""
    body = {"type": "voxels", "material": "jelly", "layers": layers}
    assert said in refusal(scene_file(), overrides={"bodies.0": body})


def test_a_grid_has_its_axes_where_the_documentation_says():
    """Read layers upwards, rows towards the viewer, columns to the right."""
    body = VoxelsBody(type="voxels", material="jelly", layers=[["#..", "..."], ["...", "..#"]])
    cells, origin, cell_size = body.grid()
    assert cells.shape == (3, 2, 2)
    assert (origin.tolist(), cell_size) == ([-0.15000000000000002, -0.1, -0.1], 0.1)
    assert {tuple(int(i) for i in cell) for cell in np.argwhere(cells.dense())} == {(0, 0, 0), (2, 1, 1)}


@pytest.mark.parametrize("text", ["a = [", "a = 1\na = 2", "= 3", "a = " + 3000 * "[" + 3000 * "]"])
def test_a_file_that_is_not_toml_is_refused(scene_file, text):
    """Name the file and the line where TOML cannot be parsed."""
    assert "not valid TOML" in refusal(scene_file(text))


def test_a_sweep_is_not_taken_for_a_scene(scene_file):
    """Say what does the runs of a sweep where a scene is asked for."""
    assert "a sweep, whose runs are done by 'warpjelly batch'" in refusal(scene_file('base = "cube.toml"'))


def test_a_model_is_not_taken_for_a_scene(tmp_path):
    """Say what a scene is where a file of another kind is given."""
    for name, content in (("tree.obj", b"v 0 0 0\n"), ("stage.usdc", b"PXR-USDC\xff\x00")):
        (tmp_path / name).write_bytes(content)
        assert "a scene is a .toml or a .w file" in refusal(tmp_path / name)


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    """Name missing files, folders and binary files."""
    assert "No such file" in refusal(tmp_path / "none.toml")
    assert "cannot read" in refusal(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    assert "not a text file" in refusal(tmp_path / "binary.toml")


def test_a_missing_model_is_refused_by_its_full_path(scene_file):
    """Look for models beside the scene file and name the place."""
    path = scene_file('[materials.m]\n[[bodies]]\ntype = "model"\nmaterial = "m"\nfile = "a.obj"\nresolution = 4\n')
    message = refusal(path)
    assert "bodies.0.file" in message
    assert str(path.parent / "a.obj") in message


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("bodies.3.size", "no entry '3'"),
        ("bodies.².size", "no entry '²'"),
        ("bodies." + 5000 * "1" + ".size", "no entry '111"),
        ("bodies.dog.size", "entries: 0, "),
        ("solver.dt.x", "not a table"),
        ("nonsense.key", "nonsense"),
    ],
)
def test_an_override_that_leads_nowhere_is_refused(scene_file, key, said):
    """Refuse dotted keys that name no entry or go through a value."""
    path = scene_file(MINIMAL + "\n[solver]\ndt = 1e-3\n")
    assert said in refusal(path, overrides={key: 1.0})


def test_overrides_reach_entries_by_number_and_name(scene_file):
    """Set keys of list entries by position and by name."""
    scene = load_scene(
        scene_file(MINIMAL.replace('type = "sphere"', 'type = "sphere"\nname = "ball"')),
        overrides={"bodies.0.size": 2.0, "colliders.ball.radius": 3.0, "output.velocities": True},
        frames=7,
    )
    assert (scene.bodies[0].size, scene.colliders[0].radius, scene.output.velocities) == (2.0, 3.0, True)
    assert scene.frame_count == 7


@pytest.mark.parametrize(
    ("fps", "dt", "substeps"), [(60.0, 1 / 600, 10), (60.0, 1e-3, 17), (24.0, 1.0, 1), (25.0, 0.0004, 100)]
)
def test_the_step_divides_the_frame(fps, dt, substeps):
    """Use the largest step that divides a frame and does not exceed dt."""
    scene = Scene.model_validate(
        {
            "name": "a",
            "fps": fps,
            "solver": {"dt": dt},
            "materials": {"m": {}},
            "bodies": [{"type": "cube", "material": "m"}],
        }
    )
    assert scene.substeps_for(dt) == substeps
    # One rounding of the division apart.
    assert 1 / (fps * substeps) <= dt * (1 + 1e-9)


@pytest.mark.parametrize("tangent", [None, (1.0, 1.0, 1.0)])
@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (0.0, 0.0, -3.0), (1.0, 2.0, 3.0), (1e-8, 1.0, 0.0)])
def test_a_plane_has_an_orthonormal_frame(normal, tangent):
    """Require unit vectors at right angles, right-handed, the normal as given."""
    plane = PlaneCollider(type="plane", normal=normal, tangent=tangent, size=(1.0, 1.0))
    frame = np.array(plane.frame())
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.cross(frame[0], frame[1]), frame[2], atol=1e-15)
    np.testing.assert_allclose(frame[2], np.array(normal) / np.linalg.norm(normal), atol=1e-15)


def test_the_resolved_scene_reads_back(scene_file):
    """Rebuild a scene from its JSON, as kept in run.json."""
    scene = load_scene(SCENES / "tree_drop.toml")
    again = Scene.model_validate(json.loads(json.dumps(scene.model_dump(mode="json", exclude_none=True))))
    assert again == scene


def test_the_schema_for_editors_is_current():
    """Compare scenes/schema.json with the models; `python -m warpjelly.scene > scenes/schema.json` renews it."""
    assert json.loads((SCENES / "schema.json").read_text()) == Scene.model_json_schema()


NETWORK = {
    "type": "network",
    "material": "jelly",
    "points": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 0.0, 0.0]],
}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"structural": [[0, 1], [1, 1]]}, ["structural.1 = [1, 1]", "two different particles"]),
        ({"shear": [[0, 4]]}, ["shear.0 = [0, 4]", "no particle 4", "0 to 3"]),
        ({"bend": [[0, -1]]}, ["bend.0.1 = -1", "greater than or equal to 0"]),
        ({"structural": [[0, 1], [1, 2]], "bend": [[2, 1]]}, ["bend.0 = [2, 1]", "by structural.1 already"]),
        ({"structural": [[2, 3]]}, ["structural.0 = [2, 3]", "rest length must be at least 1e-06 m"]),
        ({"structural": [[2, 3]], "rest_lengths": [0.0]}, ["rest_lengths.0 = 0.0", "m, one for each spring"]),
        (
            {"structural": [[0, 1]], "rest_lengths": [1.0, 2.0]},
            ["rest_lengths = [1.0, 2.0]", "2 of them for 1 springs"],
        ),
        ({"structural": [[0]]}, ["structural.0 = [0]", "must have 2 entries, not 1"]),
        ({"points": []}, ["points = []", "must not be empty"]),
        ({"pinned": [{}]}, ["pinned.0", "give indices, or lower and upper"]),
        ({"pinned": [{"indices": [0], "lower": [0, 0, 0]}]}, ["pinned.0", "give indices, or lower and upper"]),
        ({"pinned": [{"lower": [0, 0, 0]}]}, ["pinned.0", "give indices, or lower and upper"]),
        ({"pinned": [{"lower": [0, 2, 0], "upper": [1, 1, 1]}]}, ["pinned.0.lower", "must not be above upper"]),
        ({"pinned": [{"indices": []}]}, ["pinned.0.indices = []", "must not be empty"]),
        ({"type": "cloth", "points": None}, ["bodies.0.points", "unknown key"]),
    ],
)
def test_a_bad_network_is_refused_in_one_line(scene_file, changes, said):
    """Require the key, the value and what is allowed for springs and pins that cannot be."""
    message = refusal(scene_file(), overrides={"bodies": [{**NETWORK, **changes}]})
    assert "bodies.0." in message
    for part in said:
        assert part in message


@pytest.mark.parametrize(
    ("material", "said"),
    [
        ({"law": "young", "density": 1e3}, ["materials.jelly.youngs_modulus", "missing", "law young"]),
        ({"law": "young", "youngs_modulus": 1e4}, ["materials.jelly.density", "missing", "law young"]),
        (
            {"law": "young", "youngs_modulus": 1e4, "density": 1e3, "bend": {}},
            ["jelly.bend", "does not go with law young"],
        ),
        (
            {"law": "young", "youngs_modulus": 1e4, "density": 1e3, "particle_mass": 1.0},
            ["jelly.particle_mass", "does not go with law young", "density"],
        ),
        ({"youngs_modulus": 1e4}, ["jelly.youngs_modulus", "does not go with law strain", "structural, shear, bend"]),
        ({"law": "hooke", "damping_time": 0.1}, ["jelly.damping_time", "does not go with law hooke"]),
        ({"law": "young", "youngs_modulus": 0.0, "density": 1e3}, ["youngs_modulus = 0.0", "greater than 0", "Pa"]),
    ],
)
def test_keys_of_a_material_go_with_its_law(scene_file, material, said):
    """Refuse what a law does not take and ask for what it requires."""
    message = refusal(scene_file(), overrides={"materials.jelly": material})
    for part in said:
        assert part in message


@pytest.mark.parametrize("body", [NETWORK, {"type": "cloth", "material": "jelly"}])
@pytest.mark.parametrize("material", [{"density": 1e3}, {"law": "young", "youngs_modulus": 1e4, "density": 1e3}])
def test_bodies_without_volume_take_no_density(scene_file, body, material):
    """Refuse a density, and with it Young's law, for a network and a cloth."""
    message = refusal(scene_file(), overrides={"materials.jelly": material, "bodies": [body]})
    assert "bodies.0.material" in message and "has no volume" in message and "particle_mass" in message
