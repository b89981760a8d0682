"""World files like those of the jello cube course, written from their description and not by the package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

INDICES = np.array(list(product(range(8), repeat=3)))
"""(i, j, k) of each particle in file order."""


@dataclass(frozen=True)
class WorldFile:
    """What is in a file; arrays are [..., 3] in the order of the file."""

    integrator: str = "RK4"
    dt: float = 0.0005
    n: int = 1
    k_elastic: float = 200.0
    d_elastic: float = 0.25
    k_collision: float = 400.0
    d_collision: float = 0.25
    mass: float = 1 / 512
    plane: tuple[float, float, float, float] | None = None
    grid: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0, 3)))
    positions: np.ndarray = field(default_factory=lambda: INDICES / 7.0 - 0.5)
    velocities: np.ndarray = field(default_factory=lambda: np.zeros((512, 3)))

    def text(self) -> str:
        """Return the file."""
        constants = (self.k_elastic, self.d_elastic, self.k_collision, self.d_collision)
        lines = [self.integrator, f"{self.dt:.6f} {self.n}", " ".join(f"{c:.6f}" for c in constants)]
        lines.append(f"{self.mass:.6f}")
        lines.append("0" if self.plane is None else "1\n" + " ".join(f"{c:.6f}" for c in self.plane))
        lines.append(str(len(self.grid)))
        for rows in (self.grid.reshape(-1, 3), self.positions, self.velocities):
            lines += [f"{x:.6f} {y:.6f} {z:.6f}" for x, y, z in rows]
        return "\n".join(lines) + "\n"


def sample_field(force: Callable[[np.ndarray], np.ndarray], resolution: int = 30) -> np.ndarray:
    """Return a function of the place [..., 3] at all nodes of a field over the box."""
    axis = -2 + 4 * np.arange(resolution) / (resolution - 1)
    return force(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1))


def displaced_corner() -> WorldFile:
    """Pull one corner of a resting cube outwards."""
    world = WorldFile()
    positions = world.positions.copy()
    positions[-1] += 0.5
    return replace(world, positions=positions)


WORLDS = {
    # Thrown at a corner of the box and partly in it, with many particles beyond one, two and three walls.
    "corner": WorldFile(
        positions=INDICES / 7.0 + [1.2, 1.3, -2.25], velocities=np.tile([8.0, 9.0, -7.0], (512, 1)), d_collision=1.5
    ),
    "down": WorldFile(grid=sample_field(lambda p: 0.0 * p + np.array([0.0, 0.0, -0.02]))),
    "left": WorldFile(velocities=np.tile([-50.0, 0.0, 0.0], (512, 1))),
    "rotating": WorldFile(grid=sample_field(lambda p: 0.05 * np.cross([0.0, 0.0, 1.0], p))),
    "displaced": displaced_corner(),
    # Partly beyond a plane that is not of unit length, on its negative side, in a coarse field, by Euler.
    "plane": WorldFile(
        integrator="Euler",
        n=4,
        plane=(1.0, -2.0, 2.5, -1.0),
        grid=sample_field(lambda p: 0.01 * p**2, resolution=5),
        velocities=0.5 * INDICES,
    ),
}
