"""Make the models of the example scenes and write them beside this file.

Run as `python scenes/models/make_models.py`.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

# The tree is drawn in cells of the grid that its scenes use. Widths are even, because that grid is centred on
# the model: every face then lies on a cell boundary, and the jelly has exactly the shape of the model.
TREE_CELLS = 12
TREE_TRUNK = (2, 0, 12)  # width, bottom, top [cells]; it carries the crown and ends as the tip
TREE_CROWN = ((8, 3, 5), (4, 5, 6), (6, 6, 8), (4, 8, 10))  # the same, from below

# At 20 cells along the length a cell is 0.03 m. The wall is four cells thick, and the slit and the beam
# between its turns both exceed two cells, so that no turn is cut through and none touches the next. At 8 cells the slit
# is narrower than one; turned like this it still leaves the coupler in one piece there.
COUPLER_LENGTH = 0.6  # [m]
COUPLER_RADIUS = 0.25  # [m]
COUPLER_BORE = 0.13  # radius [m]
COUPLER_SLIT = 0.066  # height of the slit along the axis [m]
COUPLER_PITCH = 0.135  # [m]
COUPLER_TURNS = 2.5
COUPLER_START = 30.0  # where the slit starts around the axis [degrees]; a whole number of segments
COUPLER_SEGMENTS = 48  # straight edges per full circle

# The creature is made of lumps: (one end, other end, radius at each, how far it blends with those before) [m]. What is
# off the middle is there on both sides. At 24 cells no lump is thinner than two of them.
Point = tuple[float, float, float]
Lump = tuple[Point, Point, float, float, float]
CREATURE_LUMPS: tuple[Lump, ...] = (
    ((0.0, 0.44, -0.16), (0.0, 0.45, 0.06), 0.21, 0.20, 0.1),  # rump to chest
    ((0.0, 0.40, -0.06), (0.0, 0.40, -0.02), 0.22, 0.22, 0.1),  # belly
    ((0.0, 0.48, 0.08), (0.0, 0.64, 0.18), 0.13, 0.14, 0.1),  # neck
    ((0.0, 0.70, 0.21), (0.0, 0.69, 0.22), 0.185, 0.185, 0.08),  # head
    ((-0.035, 0.635, 0.36), (0.035, 0.635, 0.36), 0.095, 0.095, 0.1),  # snout
    ((0.12, 0.36, 0.10), (0.14, 0.08, 0.13), 0.1, 0.075, 0.06),  # fore leg
    ((0.13, 0.36, -0.22), (0.15, 0.08, -0.22), 0.12, 0.075, 0.06),  # hind leg
    ((0.10, 0.82, 0.17), (0.17, 0.90, 0.12), 0.055, 0.065, 0.05),  # ear
    ((0.17, 0.90, 0.12), (0.32, 0.80, 0.09), 0.065, 0.06, 0.04),  # its tip, which droops
    ((0.0, 0.50, -0.30), (0.0, 0.52, -0.44), 0.085, 0.06, 0.08),  # tail
    ((0.0, 0.52, -0.44), (0.0, 0.66, -0.50), 0.06, 0.055, 0.05),
    ((0.0, 0.68, -0.50), (0.0, 0.69, -0.50), 0.085, 0.085, 0.03),  # its tuft
)
CREATURE_BOUNDS = (-0.5, -0.15, -0.7, 0.5, 1.1, 0.6)  # lowest and highest corner around the skin [m]
CREATURE_EDGE = 0.036  # of the triangles of the skin [m]
# What sticks out of the skin and has a colour of its own: (one end, other end, radius at each) [m].
CREATURE_BALLS = {
    "eye": (((0.095, 0.755, 0.335), (0.095, 0.755, 0.335), 0.072, 0.072),),
    "pupil": (((0.108, 0.765, 0.367), (0.108, 0.765, 0.367), 0.046, 0.046),),
    "nose": (((0.0, 0.675, 0.44), (0.0, 0.675, 0.44), 0.042, 0.042),),
    "hoof": (
        ((0.14, 0.03, 0.145), (0.14, 0.03, 0.145), 0.098, 0.098),
        ((0.15, 0.03, -0.205), (0.15, 0.03, -0.205), 0.098, 0.098),
    ),
    "horn": (((0.0, 0.84, 0.27), (0.0, 0.965, 0.33), 0.068, 0.035),),
}
CREATURE_SEGMENTS = 20  # straight edges per full circle of these
CREATURE_COLORS: dict[str, Point] = {  # linear
    "skin": (0.11, 0.48, 0.39),
    "eye": (0.92, 0.91, 0.83),
    "pupil": (0.007, 0.006, 0.014),
    "nose": (0.85, 0.17, 0.26),
    "hoof": (0.09, 0.06, 0.11),
    "horn": (0.95, 0.65, 0.17),
}

# Bones of the creature, to be stiff inside of it: lumps as well. They are wider than a cell at 20 cells, so that its
# jelly cubes follow them without a gap. Ears and tail have none.
SKELETON_LUMPS: tuple[Lump, ...] = (
    ((0.0, 0.47, -0.23), (0.0, 0.49, 0.05), 0.06, 0.06, 0.03),  # spine
    ((0.0, 0.49, 0.05), (0.0, 0.68, 0.2), 0.06, 0.06, 0.03),  # neck
    ((0.0, 0.69, 0.2), (0.0, 0.67, 0.33), 0.1, 0.07, 0.03),  # skull
    ((0.0, 0.75, 0.23), (0.0, 0.93, 0.318), 0.05, 0.032, 0.03),  # horn
    ((0.0, 0.49, 0.05), (0.12, 0.4, 0.08), 0.06, 0.06, 0.03),  # shoulder
    ((0.0, 0.47, -0.23), (0.13, 0.4, -0.22), 0.06, 0.06, 0.03),  # hip
    ((0.12, 0.4, 0.08), (0.14, 0.06, 0.13), 0.06, 0.055, 0.03),  # fore leg
    ((0.13, 0.4, -0.22), (0.15, 0.06, -0.22), 0.06, 0.055, 0.03),  # hind leg
)

# The shot is in centimetres, z up, 24 frames a second. A moulded jelly with a cherry in its top stands a little above
# its plate: outlines from the axis outwards, up and to the axis again, (radius, height) [cm].
JELLY_RADII = (0.0, 2.6, 5.0, 5.6, 5.4, 5.1, 4.7, 4.2, 3.4, 2.0, 0.0)
JELLY_HEIGHTS = (0.0, 0.0, 0.0, 0.3, 1.7, 3.1, 4.5, 5.9, 6.8, 7.1, 7.2)
JELLY_OUTLINE = tuple(zip(JELLY_RADII, JELLY_HEIGHTS, strict=True))
JELLY_SEGMENTS, JELLY_FLUTES, JELLY_DEPTH = 48, 8, 0.06  # around the axis; how deep the flutes are, share of the radius
CHERRY_RADIUS, CHERRY_HEIGHT = 1.1, 7.9  # [cm]
CHERRY_OUTLINE = tuple(
    (CHERRY_RADIUS * math.sin(math.pi * k / 8), CHERRY_HEIGHT - CHERRY_RADIUS * math.cos(math.pi * k / 8))
    for k in range(9)
)
CHERRY_SEGMENTS = 16
SHOT_LOOKS: dict[str, tuple[Point, float]] = {
    "vanilla": ((0.85, 0.66, 0.32), 0.3),
    "caramel": ((0.32, 0.09, 0.01), 0.15),
    "cherry": ((0.5, 0.01, 0.03), 0.15),
    "china": ((0.75, 0.78, 0.8), 0.2),
    "wood": ((0.25, 0.13, 0.06), 0.6),
}  # linear colour, roughness
PLATE_OUTLINE = ((0.0, 0.0), (6.0, 0.0), (9.5, 1.2), (9.6, 1.5), (6.2, 0.4), (0.0, 0.4))


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
    return (tube - bore - slit).rotate([-90, 0, 0]).rotate([0, COUPLER_START, 0])


def creature() -> dict[str, Manifold]:
    """Return the parts of a long-eared creature, one metre tall, on four legs at y = 0; it looks along z."""
    parts = {"skin": blend(CREATURE_LUMPS)}
    for name, balls in CREATURE_BALLS.items():
        hulls = [
            Manifold.batch_hull(
                [
                    Manifold.sphere(radius, CREATURE_SEGMENTS).translate(center)
                    for center, radius in ((start, first), (end, last))
                ]
            )
            for given in balls
            for start, end, first, last, _ in both_sides((*given, 0.0))
        ]
        parts[name] = Manifold.batch_boolean(hulls, OpType.Add)
    return {name: part.trim_by_plane((0.0, 1.0, 0.0), 0.0) for name, part in parts.items()}


def skeleton() -> Manifold:
    """Return the bones of the creature where they are in it."""
    return blend(SKELETON_LUMPS)


def blend(lumps: Iterable[Lump]) -> Manifold:
    """Return lumps and their mirror images, run into each other."""
    both = [lump for given in lumps for lump in both_sides(given)]
    return Manifold.level_set(lambda x, y, z: -blended_distance(both, x, y, z), CREATURE_BOUNDS, CREATURE_EDGE)


def both_sides(lump: Lump) -> list[Lump]:
    """Return a lump and, if it is off the middle, its mirror image."""
    (start_x, *start), (end_x, *end), *rest = lump
    return [lump] if start_x == -end_x else [lump, ((-start_x, *start), (-end_x, *end), *rest)]


def blended_distance(lumps: list[Lump], x: float, y: float, z: float) -> float:
    """Return about how far a point is outside of lumps that run into each other [m].

    Only what every machine rounds alike goes into it, so that the model is the same everywhere.
    """
    distance = math.inf
    for (ax, ay, az), (bx, by, bz), first, last, blend in lumps:
        dx, dy, dz, px, py, pz = bx - ax, by - ay, bz - az, x - ax, y - ay, z - az
        along = min(1.0, max(0.0, (px * dx + py * dy + pz * dz) / (dx * dx + dy * dy + dz * dz)))
        px, py, pz = px - along * dx, py - along * dy, pz - along * dz
        other = math.sqrt(px * px + py * py + pz * pz) - first - along * (last - first)
        overlap = max(0.0, blend - abs(distance - other))
        distance = min(distance, other) - overlap * overlap / (4 * blend)
    return distance


def turned(
    outline: Sequence[tuple[float, float]], segments: int, flutes: int = 0
) -> tuple[list[Point], list[list[int]]]:
    """Return points and faces of an outline, from the axis and back to it, that is turned about the z axis."""
    inner = outline[1:-1]
    points = [(0.0, 0.0, outline[0][1])]
    for radius, height in inner:
        for k in range(segments):
            angle = 2 * math.pi * k / segments
            wide = radius * (1 + JELLY_DEPTH * math.cos(flutes * angle) if flutes else 1.0)
            points.append((wide * math.cos(angle), wide * math.sin(angle), height))
    points.append((0.0, 0.0, outline[-1][1]))
    around = [(k, (k + 1) % segments) for k in range(segments)]
    faces = [[0, 1 + b, 1 + a] for a, b in around]
    for ring in range(len(inner) - 1):
        low, high = 1 + ring * segments, 1 + (ring + 1) * segments
        faces += [[low + a, low + b, high + b, high + a] for a, b in around]
    last = 1 + (len(inner) - 1) * segments
    return points, faces + [[last + a, last + b, len(points) - 1] for a, b in around]


def usd_mesh(name: str, points: Sequence[Point], faces: Sequence[Sequence[int]], more: Iterable[str]) -> Iterator[str]:
    """Yield the lines of a mesh of a stage."""
    low, high = (tuple(pick(axis) for axis in zip(*points, strict=True)) for pick in (min, max))
    yield f'def Mesh "{name}" (prepend apiSchemas = ["MaterialBindingAPI"])'
    yield "{"
    yield f"    float3[] extent = [{usd_point(low)}, {usd_point(high)}]"
    yield f"    int[] faceVertexCounts = [{', '.join(str(len(face)) for face in faces)}]"
    yield f"    int[] faceVertexIndices = [{', '.join(str(corner) for face in faces for corner in face)}]"
    yield f"    point3f[] points = [{', '.join(map(usd_point, points))}]"
    yield from (f"    {line}" for line in more)
    yield "}"


def usd_point(point: Sequence[float]) -> str:
    """Write a point of a stage [cm]."""
    return f"({', '.join(f'{value + 0.0:.4f}' for value in point)})"


def usd_look(name: str, color: Point, roughness: float) -> Iterator[str]:
    """Yield the lines of a material of a stage."""
    yield from (
        f'def Material "{name}"',
        "{",
        f"    token outputs:surface.connect = </shot/looks/{name}/surface.outputs:surface>",
    )
    yield from ('    def Shader "surface"', "    {", '        uniform token info:id = "UsdPreviewSurface"')
    yield f"        color3f inputs:diffuseColor = ({', '.join(map(str, color))})"
    yield from (f"        float inputs:roughness = {roughness}", "        token outputs:surface", "    }", "}")


def shot_lines() -> Iterator[str]:
    """Yield the lines of a shot: a dessert on a table, its looks, a light, and a camera that moves."""

    def look(name: str) -> str:
        return f"rel material:binding = </shot/looks/{name}>"

    smooth, flat = ('uniform token subdivisionScheme = "catmullClark"', 'uniform token subdivisionScheme = "none"')
    jelly, jelly_faces = turned(JELLY_OUTLINE, JELLY_SEGMENTS, JELLY_FLUTES)
    sauce = range(len(jelly_faces) - 2 * JELLY_SEGMENTS, len(jelly_faces))
    subset = (
        'uniform token subsetFamily:materialBind:familyType = "nonOverlapping"',
        'def GeomSubset "sauce" (prepend apiSchemas = ["MaterialBindingAPI"])',
        "{",
        '    uniform token elementType = "face"',
        '    uniform token familyName = "materialBind"',
        f"    int[] indices = [{', '.join(map(str, sauce))}]",
        f"    {look('caramel')}",
        "}",
    )
    yield from (
        "#usda 1.0",
        "(",
        '    "Made by scenes/models/make_models.py; change that script, not this file."',
        '    defaultPrim = "shot"',
        "    startTimeCode = 1001",
        "    endTimeCode = 1036",
        "    timeCodesPerSecond = 24",
        "    framesPerSecond = 24",
        "    metersPerUnit = 0.01",
        '    upAxis = "Z"',
        ")",
        'def Xform "shot" (kind = "assembly")',
        "{",
        '    def Xform "dessert"',
        "    {",
        "        double3 xformOp:translate = (20, 10, 3)",
        "        float3 xformOp:rotateXYZ = (6, 4, 30)",
        '        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]',
    )
    for line in usd_mesh("jelly", jelly, jelly_faces, (smooth, look("vanilla"), *subset)):
        yield f"        {line}"
    for line in usd_mesh("cherry", *turned(CHERRY_OUTLINE, CHERRY_SEGMENTS), (smooth, look("cherry"))):
        yield f"        {line}"
    yield "    }"
    place = ("double3 xformOp:translate = (20, 10, 0)", 'uniform token[] xformOpOrder = ["xformOp:translate"]')
    for line in usd_mesh("plate", *turned(PLATE_OUTLINE, JELLY_SEGMENTS), (smooth, look("china"), *place)):
        yield f"    {line}"
    table: list[Point] = [(-60.0, -60.0, 0.0), (100.0, -60.0, 0.0), (100.0, 80.0, 0.0), (-60.0, 80.0, 0.0)]
    for line in usd_mesh("table", table, [[0, 1, 2, 3]], (flat, look("wood"))):
        yield f"    {line}"
    yield from (
        '    def Camera "camera"',
        "    {",
        "        float focalLength = 50",
        "        float focusDistance = 49",
        "        float horizontalAperture = 36",
        "        float verticalAperture = 20.25",
        "        float2 clippingRange = (1, 1000)",
        "        double3 xformOp:translate.timeSamples = { 1001: (20, -36, 18), 1036: (22.5, -36, 18) }",
        "        float3 xformOp:rotateXYZ = (75, 0, 0)",
        '        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]',
        "    }",
        '    def DomeLight "sky"',
        "    {",
        "        float inputs:intensity = 1",
        "    }",
        '    def Scope "looks"',
        "    {",
    )
    for name, (color, roughness) in SHOT_LOOKS.items():
        for line in usd_look(name, color, roughness):
            yield f"        {line}"
    yield from ("    }", "}")


def obj_lines(parts: dict[str, Manifold], library: str) -> Iterator[str]:
    """Yield the lines of an OBJ file of the union of parts, in an order that depends on the geometry alone.

    Args:
        parts: the first one is the body, and of a single one nothing but its shape is written.
        library: the MTL file with a material for each part.
    """
    names = {}
    for name, part in parts.items():
        parts[name] = part.as_original()
        names[parts[name].original_id()] = name
    mesh = Manifold.batch_boolean(list(parts.values()), OpType.Add).to_mesh64()
    points, indices = np.unique(np.round(mesh.vert_properties[:, :3], 6) + 0.0, axis=0, return_inverse=True)
    faces = indices.reshape(-1)[mesh.tri_verts]
    first = faces.argmin(axis=1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1) + 1
    owners = np.repeat(mesh.run_original_id, np.diff(mesh.run_index) // 3)
    yield "# Made by scenes/models/make_models.py; change that script, not this file. Metres, y up."
    if len(parts) > 1:
        yield f"mtllib {library}"
    yield from (f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points)
    for owner, name in names.items():
        if len(parts) > 1:
            yield from (f"g {name}", f"usemtl {name}")
        part_faces = faces[owners == owner]
        yield from (f"f {a} {b} {c}" for a, b, c in part_faces[np.lexsort(part_faces.T[::-1])])


def mtl_lines(colors: dict[str, Point]) -> Iterator[str]:
    """Yield the lines of an MTL file."""
    yield "# Made by scenes/models/make_models.py; change that script, not this file."
    for name, color in colors.items():
        yield from (f"newmtl {name}", "Kd {:.3f} {:.3f} {:.3f}".format(*color))


def write_models(folder: Path) -> None:
    """Write every model into `folder`."""
    models = {make.__name__: {make.__name__: make()} for make in (tree, coupler, skeleton)} | {"creature": creature()}
    texts = {f"{name}.obj": obj_lines(parts, f"{name}.mtl") for name, parts in models.items()}
    texts["creature.mtl"] = mtl_lines(CREATURE_COLORS)
    texts["dessert.usda"] = shot_lines()
    for name, lines in texts.items():
        (folder / name).write_bytes(("\n".join(lines) + "\n").encode("ascii"))


if __name__ == "__main__":
    write_models(Path(__file__).parent)
