"""Effective stiffness of the three laws: the continuum that a lattice stands for, by linear statics in float64."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import make_material, make_scene, make_voxels

from warpjelly.model import build
from warpjelly.plan import plan_scene

E, DENSITY = 2e4, 900.0
YOUNG = {"law": "young", "youngs_modulus": E, "density": DENSITY, "damping_time": 3e-3}
# Springs of a lattice in the notation of crystals: along the edge, the face diagonal and the body diagonal of a cell.
DIRECTIONS = {"100": (1, 0, 0), "110": (1, 1, 0), "111": (1, 1, 1)}


class Solid:
    """A body of a scene as springs between particles, read back from the model that the simulator uses."""

    def __init__(self, cells: np.ndarray, *, edge: float, **material: object) -> None:
        material = material or YOUNG
        # Cells with the numbers 2, 3, ... are of that many times the modulus.
        regions = [{"symbol": "_abcdefgh"[n - 1], "material": f"jelly_{n}"} for n in np.unique(cells) if n > 1]
        body = make_voxels(cells, cell_size=edge, regions=regions)
        harder = {f"jelly_{n}": {**YOUNG, "youngs_modulus": n * E} for n in range(2, 10)}
        scene = make_scene(materials={"jelly": material} | harder, bodies=[body])
        model, state = build(plan_scene(scene), device="cpu")
        spans = model.spans.numpy()
        run = np.concatenate([np.arange(count) for count in spans[:, 2]])
        first, second, _, row = np.repeat(spans, spans[:, 2], axis=0).T
        self.x = state.x.numpy().T.copy()
        self.mass = model.particle_mass.numpy()
        self.volume = np.count_nonzero(cells) * edge**3
        self.ends = np.stack([first, second], axis=1) + run[:, None]
        self.rest, self.stiffness, self.damping = model.spring_classes.numpy()[row].T
        offset = self.x[self.ends[:, 1]] - self.x[self.ends[:, 0]]
        self.direction = offset / np.linalg.norm(offset, axis=1)[:, None]

    def elasticity(self) -> np.ndarray:
        """Return the tensor C_ijkl [Pa] from the energy of affine strain e: V/2 e:C:e = sum k (r n.e.n)^2 / 2."""
        n = self.direction
        return np.einsum("s,si,sj,sk,sl->ijkl", self.stiffness * self.rest**2, n, n, n, n) / self.volume

    def solve(self, loads: np.ndarray, fixed: np.ndarray) -> np.ndarray:
        """Return the small displacements under each load, [m, n, 3], in m.

        Particles go slice by slice along x and no spring spans more than two, so the stiffness matrix is block
        tridiagonal in pairs of slices.

        Args:
            loads: forces, [m, n, 3], N.
            fixed: which components stay zero, bool [n, 3].
        """
        pair = 2 * int(np.sum(self.x[:, 0] == self.x[0, 0]))
        block_count, size = -(-len(self.x) // pair), 3 * pair
        # Row block, then 0 for the diagonal block and 1 for the one to the right of it.
        matrix = np.zeros((block_count, 2, size, size))
        tensors = np.einsum("s,si,sj->sij", self.stiffness, self.direction, self.direction)
        for a, b, sign in ((0, 0, 1), (1, 1, 1), (0, 1, -1), (1, 0, -1)):
            row, column = (self.ends[:, [a, b]] // pair).T
            kept = column >= row
            at = 3 * (self.ends[kept][:, [a, b]] % pair)
            for i, j in np.ndindex(3, 3):
                place = (row[kept], (column - row)[kept], at[:, 0] + i, at[:, 1] + j)
                np.add.at(matrix, place, sign * tensors[kept, i, j])
        # The last pair may be incomplete: what is not there is held.
        held = np.ones((block_count * pair, 3), bool)
        held[: len(self.x)] = fixed
        held = held.reshape(block_count, size)
        right = np.zeros((block_count * pair, 3, len(loads)))
        right[: len(self.x)] = np.where(fixed[..., None], 0.0, np.moveaxis(loads, 0, -1))
        right = right.reshape(block_count, size, len(loads))
        for block in range(block_count):
            matrix[block, 0] *= ~held[block][:, None] & ~held[block]
            matrix[block, 0] += np.diag(held[block].astype(float))
            if block + 1 < block_count:
                matrix[block, 1] *= ~held[block][:, None] & ~held[block + 1]
        for block in range(1, block_count):
            above, link = matrix[block - 1]
            solved = np.linalg.solve(above, np.concatenate([link, right[block - 1]], axis=1))
            matrix[block, 0] -= link.T @ solved[:, :size]
            right[block] -= link.T @ solved[:, size:]
        for block in range(block_count)[::-1]:
            if block + 1 < block_count:
                right[block] -= matrix[block, 1] @ right[block + 1]
            right[block] = np.linalg.solve(matrix[block, 0], right[block])
        return np.moveaxis(right.reshape(-1, 3, len(loads))[: len(self.x)], -1, 0)


WIDTH, SLENDERNESS = 0.3, 5
LENGTH = WIDTH * SLENDERNESS


def make_bar(across: int) -> tuple[Solid, np.ndarray, np.ndarray]:
    """Return a bar along x and each particle's share of its left and of its right end face, [n] each."""
    bar = Solid(np.ones((across * SLENDERNESS, across, across), bool), edge=WIDTH / across)
    at_side = np.isclose(np.abs(bar.x[:, 1:]), WIDTH / 2)
    share = np.prod(np.where(at_side, 0.5, 1.0), axis=1) / across**2
    return bar, share * np.isclose(bar.x[:, 0], -LENGTH / 2), share * np.isclose(bar.x[:, 0], LENGTH / 2)


def directional_modulus(elasticity: np.ndarray, direction: tuple[int, int, int]) -> tuple[float, float]:
    """Return Young's modulus [Pa] along a direction and the mean of Poisson's ratio around it."""
    n = np.array(direction) / np.linalg.norm(direction)
    stress = np.outer(n, n)
    # Symmetric strain by least squares: the tensor does not see antisymmetric ones.
    strain = np.linalg.lstsq(elasticity.reshape(9, 9), stress.ravel(), rcond=None)[0].reshape(3, 3)
    along = n @ strain @ n
    return 1.0 / along, -(np.trace(strain) - along) / (2.0 * along)


@pytest.mark.parametrize("across", [1, 2, 4, 6])
def test_bars_stretch_as_the_continuum(across: int) -> None:
    """Pull a bar by F and hang it by one end: the elongations are F L/(E A) and rho g L^2/(2 E)."""
    bar, left, right = make_bar(across)
    pull, hang = np.zeros((2, *bar.x.shape))
    pull[:, 0] = 2.0 * (right - left)
    hang[:, 0] = 9.81 * (bar.mass - bar.mass.sum() * left)
    # Both loads are balanced; six components hold the bar without any reaction.
    fixed = np.zeros(bar.x.shape, bool)
    corner, beside, above = np.flatnonzero(left)[[0, across, -1 - across]]
    fixed[corner] = fixed[beside, :2] = fixed[above, 0] = True
    stretches = bar.solve(np.stack([pull, hang]), fixed)[:, :, 0] @ (right - left)
    expected = [2.0 * LENGTH / (E * WIDTH**2), DENSITY * 9.81 * LENGTH**2 / (2 * E)]
    # Weighted by cells, the lattice has the continuum's solution exactly; what is left is the rounding of a matrix
    # whose condition is about (length / cell)^4 = 30^4.
    np.testing.assert_allclose(stretches, expected, rtol=30**4 * 2.0**-52)


@pytest.mark.parametrize("across", [2, 4, 6])
def test_bars_of_two_materials_side_by_side_stretch_as_the_continuum(across: int) -> None:
    """Pull a bar whose upper half is 9 times as hard, each half by its share: the elongation is F L/(E1 A1 + E2 A2)."""
    cells = np.ones((across * SLENDERNESS, across, across), int)
    cells[:, across // 2 :] = 9
    edge = WIDTH / across
    bar = Solid(cells, edge=edge)
    # Both halves contract sideways alike, having one Poisson's ratio: the continuum's strain is uniform.
    modulus, strain = E * cells[0], 0.01
    load = np.zeros((1, *bar.x.shape))
    place = np.rint(bar.x[:, 1:] / edge + across / 2).astype(int)
    for corner in np.ndindex(2, 2):
        around = np.pad(modulus, 1)[tuple((place + corner).T)]
        load[0, :, 0] += (
            around * strain * edge**2 / 4 * np.sign(bar.x[:, 0]) * np.isclose(np.abs(bar.x[:, 0]), LENGTH / 2)
        )
    assert load[0, :, 0].max() > 0 and abs(load.sum()) < 1e-12 * np.abs(load).sum()
    fixed = np.zeros(bar.x.shape, bool)
    corner, beside, above = np.flatnonzero(np.isclose(bar.x[:, 0], -LENGTH / 2))[[0, across, -1 - across]]
    fixed[corner] = fixed[beside, :2] = fixed[above, 0] = True
    found = bar.solve(load, fixed)[0]
    expected = (bar.x - bar.x[corner]) * np.array([strain, -strain / 4, -strain / 4])
    # As for a bar of one material.
    np.testing.assert_allclose(found, expected, rtol=0, atol=30**4 * 2.0**-52 * strain * LENGTH)


@pytest.mark.parametrize("across", [1, 2, 4])
def test_bars_of_two_materials_in_series_stretch_as_the_continuum(across: int) -> None:
    """Pull a bar, held sideways, whose right part is 9 times as hard: the strains are stress / (1.2 E)."""
    cells = np.ones((across * SLENDERNESS, across, across), int)
    cells[2 * across :] = 9
    bar = Solid(cells, edge=WIDTH / across)
    _, left, right = make_bar(across)
    load = np.zeros((1, *bar.x.shape))
    load[0, :, 0] = 2.0 * right
    fixed = np.repeat([[False, True, True]], len(bar.x), axis=0)
    fixed[:, 0] = left > 0
    found = bar.solve(load, fixed)[0, :, 0]
    # Uniaxial strain: C11 = 1.2 E.
    stress, interface = 2.0 / WIDTH**2, 2 * WIDTH
    along = bar.x[:, 0] + LENGTH / 2
    expected = stress / (1.2 * E) * (np.minimum(along, interface) + np.maximum(along - interface, 0) / 9)
    np.testing.assert_allclose(found, expected, rtol=0, atol=30**4 * 2.0**-52 * expected.max())


def test_a_cantilever_converges_with_the_resolution() -> None:
    """Bend a clamped bar by a force at its tip: closer to Timoshenko's beam with every refinement, never softer."""
    errors = {}
    for across in (1, 2, 4, 6):
        bar, left, right = make_bar(across)
        load = np.zeros((1, *bar.x.shape))
        load[0, :, 1] = right
        fixed = np.repeat(left[:, None] > 0, 3, axis=1)
        deflection = bar.solve(load, fixed)[0, :, 1] @ right
        shear_modulus = E / (2 * 1.25)
        beam = LENGTH**3 / (3 * E * WIDTH**4 / 12) + LENGTH / (5 / 6 * shear_modulus * WIDTH**2)
        errors[across] = 1.0 - deflection / beam
    # Bending varies the strain over the section; a cell, whose strain is uniform at best, misses a share of 1/across^2
    # of it, up to the fixed stiffening by the clamp. First order is required, and 5 % at 6 cells.
    # The documentation has the ratios with two digits.
    np.testing.assert_allclose(1.0 - np.array(list(errors.values())), [0.45, 0.75, 0.92, 0.96], rtol=0, atol=5e-3)
    assert 0 < errors[2] < errors[1] / 2
    assert 0 < errors[4] < errors[2] / 2
    assert 0 < errors[6] < 0.05


@pytest.mark.parametrize("hardest", [1, 8])
@pytest.mark.parametrize("seed", range(8))
def test_every_shape_has_the_same_modulus_in_all_directions(seed: int, hardest: int) -> None:
    """Strain random shapes of cells alike everywhere: E along 100, 110 and 111, and Poisson's ratio 1/4.

    Of several materials, the mean of the cells' moduli takes the place of E.
    """
    rng = np.random.default_rng(seed)
    cells = (rng.random((3, 4, 3)) < rng.uniform(0.2, 1.0)) * rng.integers(1, hardest + 1, (3, 4, 3))
    body = Solid(cells, edge=0.2)
    elasticity = body.elasticity() / cells[cells > 0].mean()
    lame = 0.4 * E
    identity = np.eye(3)
    expected = lame * sum(
        np.einsum(f"{a},{b}->ijkl", identity, identity) for a, b in (("ij", "kl"), ("ik", "jl"), ("il", "jk"))
    )
    # Sums of some hundred springs, all of one sign.
    np.testing.assert_allclose(elasticity, expected, rtol=0, atol=1e-13 * E)
    for direction in DIRECTIONS.values():
        # A least-squares solution of condition 5/2.
        np.testing.assert_allclose(directional_modulus(elasticity, direction), [E, 0.25], rtol=1e-12)


@pytest.mark.parametrize("hardest", [1, 8])
@pytest.mark.parametrize("seed", range(8))
def test_every_cell_pulls_its_corners_as_the_continuum(seed: int, hardest: int) -> None:
    """Stretch random shapes along their axes: the stress s pulls each corner of each cell with (h^2/4) s (1, 1, 1)."""
    rng = np.random.default_rng(seed)
    h, cells = 0.2, rng.random((4, 4, 5)) < rng.uniform(0.2, 1.0)
    cells = cells * rng.integers(1, hardest + 1, cells.shape)
    body = Solid(cells, edge=h)
    # Sheared, a body diagonal also pulls across the plane of shear, which only its neighbours balance.
    strain = np.diag(rng.normal(size=3))
    stress = 0.4 * E * (np.trace(strain) * np.eye(3) + 2 * strain)
    tension = body.stiffness * body.rest * np.einsum("si,ij,sj->s", body.direction, strain, body.direction)
    # Cells that part share a vertex, but no particle: what their particles feel is added up.
    found, expected = np.zeros((2, 5, 5, 6, 3))
    vertex = np.rint(body.x / h + np.array(cells.shape) / 2).astype(int)
    for end, sign in ((0, 1), (1, -1)):
        np.add.at(found, tuple(vertex[body.ends[:, end]].T), sign * tension[:, None] * body.direction)
    for cell in np.argwhere(cells):
        for corner in np.ndindex(2, 2, 2):
            pull = stress * cells[tuple(cell)]
            expected[tuple(cell + corner)] += h**2 / 4 * pull @ (1.0 - 2.0 * np.array(corner))
    # Up to 26 springs at a particle, each far below E h^2.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * hardest * E * h**2)


def test_mass_and_damping_follow_the_volume_and_the_stiffness() -> None:
    """Give each cell its mass, and each spring one damping time."""
    body = Solid(np.random.default_rng(1).random((4, 3, 3)) < 0.5, edge=0.1)
    np.testing.assert_allclose(body.mass.sum(), DENSITY * body.volume, rtol=1e-14)
    np.testing.assert_allclose(body.damping, 3e-3 * body.stiffness, rtol=1e-15)
    assert (body.stiffness > 0).all()


def test_no_spring_pushes_back() -> None:
    """Join two slabs of 4 cells by a single one, where bend springs over a weak spring join strong ones."""
    cells = np.ones((2, 2, 3), bool)
    cells[:, :, 1] = [[True, False], [False, False]]
    # The edge in the middle is in one cell: 0.6/4 less twice two bend springs of 0.05/4, in E h.
    body = Solid(cells, edge=0.1)
    np.testing.assert_allclose(body.stiffness.min() / (E * 0.1), 0.05 / 4, rtol=1e-12)
    at_neck = (np.abs(body.x[body.ends].mean(axis=1)) < 1e-9).all(axis=1) & np.isclose(body.rest, 0.1)
    np.testing.assert_allclose(body.stiffness[at_neck] / (E * 0.1), 0.15 - 4 * 0.0125, rtol=1e-12)


# What ARCHITECTURE.md states of lattices with the same constant k for every kind of spring. Sums over the springs of a
# particle inside, k r^2 n n n n / h^3: 1 structural, 4 face, 4 body diagonals and 1 bend spring have a part along x.
LAWS = {
    "hooke": (1 + 4 * 2 / 4 + 4 * 3 / 9 + 4, 2 * 2 / 4 + 4 * 3 / 9, [7.3125, 6.2281, 5.9348], 0.21875),
    "strain": (1 + 2**0.5 + 4 * 3**0.5 / 9 + 2, 2**0.5 / 2 + 4 * 3**0.5 / 9, [4.5291, 3.9186, 3.7501], 0.22173),
}


@pytest.mark.parametrize("law", LAWS)
def test_equal_constants_have_the_stated_moduli(law: str) -> None:
    """Find the moduli and the anisotropy that the documentation states for the laws strain and hooke."""
    h, k = 0.1, 50.0
    body = Solid(np.ones((5, 5, 5), bool), edge=h, **make_material(k, 0.0, law=law))
    inside = np.flatnonzero((np.abs(body.x) < 0.06).all(axis=1))[0]
    # Half of each spring at a particle inside belongs to its cell.
    body.stiffness = body.stiffness * (body.ends == inside).any(axis=1) / 2
    body.volume = h**3
    elasticity = body.elasticity()
    unit = k / h if law == "hooke" else k / h**2
    c11, c12, moduli, poisson = LAWS[law]
    # Thirty springs of one sign.
    np.testing.assert_allclose(
        [elasticity[0, 0, 0, 0], elasticity[0, 0, 1, 1]], np.array([c11, c12]) * unit, rtol=1e-14
    )
    np.testing.assert_allclose(elasticity[0, 1, 0, 1], elasticity[0, 0, 1, 1], rtol=1e-14)
    found = [directional_modulus(elasticity, direction) for direction in DIRECTIONS.values()]
    # A cubic crystal: 1/E(n) = s11 - 2 (s11 - s12 - s44/2) (n1^2 n2^2 + n2^2 n3^2 + n3^2 n1^2), with c44 = c12.
    s11, s12 = np.array([c11 + c12, -c12]) / ((c11 - c12) * (c11 + 2 * c12))
    crystal = [1 / (s11 - 2 * (s11 - s12 - 0.5 / c12) * share) for share in (0, 1 / 4, 1 / 3)]
    np.testing.assert_allclose([modulus / unit for modulus, _ in found], crystal, rtol=1e-12)
    # The documentation has five digits.
    np.testing.assert_allclose(crystal, moduli, rtol=3e-5)
    np.testing.assert_allclose(found[0][1], poisson, rtol=3e-5)
