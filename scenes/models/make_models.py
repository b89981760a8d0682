"""Make the models of the example scenes and write them beside this file.

Run as `python scenes/models/make_models.py`.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

# The tree is drawn in cells of the grid that its scenes use. Widths are even, because that grid is centred on
# the model: every face then lies on a cell boundary, and the jelly has exactly the shape of the model.
TREE_CELLS = 12
TREE_TRUNK = (2, 0, 12)  # width, bottom, top [cells]; it carries the crown and ends as the tip
TREE_CROWN = ((8, 3, 5), (4, 5, 6), (6, 6, 8), (4, 8, 10))  # the same, from below

# At 20 cells along the length a cell is 0.03 m. The wall is four cells thick, and the slit and the beam
# between its turns both exceed two cells, so that no turn is cut through and none touches the next.
COUPLER_LENGTH = 0.6  # [m]
COUPLER_RADIUS = 0.25  # [m]
COUPLER_BORE = 0.13  # radius [m]
COUPLER_SLIT = 0.066  # height of the slit along the axis [m]
COUPLER_PITCH = 0.135  # [m]
COUPLER_TURNS = 2.5
COUPLER_SEGMENTS = 48  # straight edges per full circle


def tree() -> Manifold:
    """Return a blocky fir, one metre tall, that stands on y = 0 around the y axis."""
    boxes = [
        Manifold.cube([width, top - bottom, width]).translate([-width / 2, bottom, -width / 2])
        for width, bottom, top in (TREE_TRUNK, *TREE_CROWN)
    ]
    return Manifold.batch_boolean(boxes, OpType.Add).scale([1 / TREE_CELLS] * 3)


def coupler() -> Manifold:
    """Return an elastic shaft coupler along the y axis: a tube whose middle is cut into a helical beam."""
    tube = Manifold.cylinder(COUPLER_LENGTH, COUPLER_RADIUS, circular_segments=COUPLER_SEGMENTS, center=True)
    bore = Manifold.cylinder(2 * COUPLER_LENGTH, COUPLER_BORE, circular_segments=COUPLER_SEGMENTS, center=True)

    def wind(point: tuple[float, float, float]) -> tuple[float, float, float]:
        radius, offset, turns = point
        angle = 2 * math.pi * turns
        # Minus, because (radius, offset, angle) is a left-handed frame: plus would turn the slit inside out.
        height = COUPLER_PITCH * (turns - COUPLER_TURNS / 2) - offset
        return radius * math.cos(angle), radius * math.sin(angle), height

    # The slit starts inside the bore and ends outside the tube: no face of it coincides with one of theirs.
    inner, outer = COUPLER_BORE / 2, 1.2 * COUPLER_RADIUS
    section = CrossSection.square([outer - inner, COUPLER_SLIT]).translate([inner, -COUPLER_SLIT / 2])
    steps = round(COUPLER_TURNS * COUPLER_SEGMENTS)
    slit = Manifold.extrude(section, COUPLER_TURNS, n_divisions=steps - 1).warp(wind)
    return (tube - bore - slit).rotate([-90, 0, 0])


def obj_lines(solid: Manifold) -> Iterator[str]:
    """Yield the lines of an OBJ file in an order that depends on the geometry alone."""
    mesh = solid.to_mesh64()
    points, indices = np.unique(np.round(mesh.vert_properties[:, :3], 6) + 0.0, axis=0, return_inverse=True)
    faces = indices.reshape(-1)[mesh.tri_verts]
    first = faces.argmin(axis=1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])] + 1
    yield "# Made by scenes/models/make_models.py; change that script, not this file. Metres, y up."
    yield from (f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points)
    yield from (f"f {a} {b} {c}" for a, b, c in faces)


def write_models(folder: Path) -> None:
    """Write every model into `folder`."""
    for make in (tree, coupler):
        text = "\n".join(obj_lines(make())) + "\n"
        (folder / f"{make.__name__}.obj").write_bytes(text.encode("ascii"))


if __name__ == "__main__":
    write_models(Path(__file__).parent)
