"""What memory a run takes at its peak, term by term: ARCHITECTURE.md has the table of what stays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from warpjelly.kernels.integrators import STAGES

from .scene import PlaneCollider, Scene, SphereCollider

if TYPE_CHECKING:
    from .plan import BodyPlan

# Warp's strides are int32, so a row of an array [3, particle_count] holds at most this many bytes: the gap behind it
# (``model.new_rows``) is less than two pages.
MAX_ROW_BYTES = 2**31 - 2 * 4096
BYTES_PER_NUMBER = {"float32": 4, "float64": 8}

# Pages of libraries that the process maps: how many of them count as its memory, the kernel decides.
BYTES_OF_LIBRARIES = 222e6
# What the program and its packages take themselves; reading a model needs more of them.
BYTES_AT_REST = 94e6
PROGRAM_BYTES = BYTES_OF_LIBRARIES + BYTES_AT_REST
BYTES_OF_MODELS = 23e6
# Numbers that stay of each particle, in the precision of the scene: three each of x, v, f and x_start, mass and inverse
# mass; for the stages of Runge-Kutta schemes v_start and two sums.
NUMBERS, STAGE_NUMBERS = 14, 9
# Boxes and sums of chunks, and flags that come and go.
BYTES_PER_PARTICLE = 2
# Numbers that come and go: what a checkpoint copies; vectors that find the largest stable step; for what a scene
# expects, positions and velocities, and what is made of them.
CHECKPOINT_NUMBERS, LIMIT_NUMBERS, SHAPE_NUMBERS, SPEED_NUMBERS = 12, 14, 18, 7
# A state of up to so many bytes is copied for its checkpoint, which is written beside the simulation; with a larger one
# the simulation waits.
COPIED_BYTES = 200e6
# A span, and what its dampers took; of which this is copied, or needed once more.
BYTES_PER_SPAN, LOSS_BYTES = 24, 8
# Making what is shown; then point, normal, colour and force of a point at a frame.
BYTES_PER_POINT, BYTES_PER_SAMPLE = 240, 36
# A particle that may collide with others, with its neighbours.
BYTES_PER_SKIN_POINT = 400
# While a lattice is built: its grid, vertices and cells; spans that are put in order; and where the vertices of a row
# along z are, for all rows of the grid, also where nothing is occupied.
BYTES_PER_BUILT_PARTICLE, BYTES_PER_BUILT_SPAN, BYTES_PER_ROW = 20, 58, 16
# The mesh of a model. Voxelising sorts where rays through the columns of cells cross it, and works on that.
BYTES_PER_TRIANGLE = 990
BYTES_PER_CROSSING = 150

# A run warns of a step above the limit where finding the limit takes at most this share of it, or at most as long as
# evaluating the forces of so many springs once each, a second or less. It takes so many evaluations, or more.
LIMIT_SHARE = 0.02
LIMIT_SPRINGS = 100_000_000
LIMIT_EVALUATIONS = 60


def body_bytes(body: BodyPlan, scene: Scene, samples: int) -> int:
    """Return what stays of a body for the run, with so many samples of what is shown, bytes."""
    return (
        _particle_bytes(scene) * body.particle_count
        + BYTES_PER_SPAN * body.span_estimate
        + (BYTES_PER_POINT + BYTES_PER_SAMPLE * samples) * body.point_estimate
        + BYTES_PER_SKIN_POINT * scene.soft_contacts * body.skin_count
        + BYTES_PER_TRIANGLE * body.triangle_count
    )


def built_bytes(body: BodyPlan) -> int:
    """Return what it takes to build a body's lattice alone, bytes."""
    return (
        BYTES_PER_BUILT_PARTICLE * body.particle_count
        + BYTES_PER_BUILT_SPAN * body.span_estimate
        + BYTES_PER_ROW * body.row_count
        + BYTES_PER_TRIANGLE * body.triangle_count
    )


def peak_bytes(bodies: Sequence[BodyPlan], scene: Scene, samples: int) -> int:
    """Return what a run takes at its peak, the program included, bytes."""
    stays = sum(body_bytes(body, scene, samples) for body in bodies)
    simulating = stays + _passing_bytes(bodies, scene)
    building = max(map(built_bytes, bodies))
    rest = PROGRAM_BYTES + BYTES_OF_MODELS * any(body.triangle_count for body in bodies)
    return int(rest + max(simulating, building))


def _particle_bytes(scene: Scene) -> int:
    """Return what stays of each particle, bytes."""
    numbers = NUMBERS + STAGE_NUMBERS * (scene.solver.integrator in STAGES)
    entered = sum(isinstance(collider, SphereCollider) and collider.normal == "entry" for collider in scene.colliders)
    planes = sum(isinstance(collider, PlaneCollider) for collider in scene.colliders)
    # Of contacts that are remembered, the step and maybe the normal; with fields, the charge and the work.
    numbers += 3 * entered + bool(scene.fields)
    small = BYTES_PER_PARTICLE + 4 * (entered + planes) + 8 * bool(scene.fields)
    return BYTES_PER_NUMBER[scene.solver.precision] * numbers + small


def _passing_bytes(bodies: Sequence[BodyPlan], scene: Scene) -> float:
    """Return the most that comes and goes during a run, bytes."""
    per_number = BYTES_PER_NUMBER[scene.solver.precision] * sum(body.particle_count for body in bodies)
    losses = LOSS_BYTES * sum(body.span_estimate for body in bodies)
    quantities = {quantity for _, quantity, _ in scene.expect.items()}
    if (copied := CHECKPOINT_NUMBERS * per_number + losses) > COPIED_BYTES:
        copied = 0
    shapes = SHAPE_NUMBERS * per_number if quantities & {"rotation", "shape_error"} else 0
    speeds = SPEED_NUMBERS * per_number if "speed" in quantities else 0
    dt, springs = scene.solver.dt, sum(body.spring_bound for body in bodies)
    seeks = dt == "auto" or seeks_limits(springs, scene.substeps_for(dt) * scene.frame_count, LIMIT_EVALUATIONS)
    limits = LIMIT_NUMBERS * per_number + losses if seeks else 0
    return max(copied, shapes, speeds, limits)


def seeks_limits(springs: int, steps: int, evaluations: int) -> bool:
    """Say whether a run of so many springs and steps looks for the largest stable step, by so many evaluations."""
    return evaluations * springs <= LIMIT_SPRINGS or evaluations <= LIMIT_SHARE * steps
