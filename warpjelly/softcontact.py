"""Soft against soft on a device: who is near whom, and the forces between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from warpjelly.kernels import bounds, pairs

from .model import Model, State

# Cells along each axis of the grid in which colliding particles are sorted; it repeats beyond.
GRID_SIZE = 32


class SoftContact:
    """Contact between the particles of a scene whose model has a skin.

    Args:
        model: has the skin.
        state: whose particles collide.
        culling: skip the search for whom is near no other body; results are the same.
    """

    def __init__(self, model: Model, state: State, *, culling: bool) -> None:
        self._model = model
        self._state = state
        skin: Any = model.skin
        self._skin = skin
        self._device = state.x.device
        self.culls = culling and not skin.with_itself
        """Whether ``search`` goes by the boxes of chunks."""
        chunk_count, body_count = len(model.chunk_body), len(model.bodies)
        with wp.ScopedDevice(self._device):
            self._body_lower, self._body_upper = (wp.zeros((3, body_count), dtype=model.real) for _ in range(2))
            self._near_lower, self._near_upper = (wp.zeros((3, chunk_count), dtype=model.real) for _ in range(2))
            self._meetings = wp.zeros(1, dtype=wp.int32)
            self._grid = wp.HashGrid(GRID_SIZE, GRID_SIZE, GRID_SIZE, dtype=model.real)
            self._grid.reserve(len(skin.particles))
            self._points = wp.zeros_like(skin.rest)
            self._energies = wp.zeros(len(self._points), dtype=wp.float64)
            self._overlaps = wp.zeros(len(self._points), dtype=wp.float64)
        # Kernels compile at their first launch, which must not be inside a capture.
        self._build_grid()

    def search(self, lower: wp.array, upper: wp.array) -> None:
        """Find who may touch whom; nobody does without a grid, which is not built where no body is near another.

        Args:
            lower: lowest corners of the boxes around the chunks, real [3, chunk_count], m; read if ``culls``.
            upper: their highest corners.
        """
        if not self.culls:
            self._build_grid()
            return
        model, boxes, body_boxes = self._model, [lower, upper], [self._body_lower, self._body_upper]
        self._launch(bounds.update_body_bounds, len(model.bodies), [model.body_chunk_start, *boxes], body_boxes)
        self._meetings.zero_()
        self._launch(
            pairs.find_meetings,
            len(model.chunk_body),
            [model.chunk_body, model.body_chunk_start, self._skin, *boxes, *body_boxes],
            [self._near_lower, self._near_upper, self._meetings],
        )
        if self._device.is_cpu:
            wp.capture_if(self._meetings, self._build_grid)
        else:
            # A GPU would have to wait for the host to hear of the meetings.
            self._build_grid()

    def add_forces(self, launch: Callable[..., None], *, dt: float, loss_weight: float, ahead: float) -> None:
        """Add the forces between particles to those of the state, after a search.

        Args:
            launch: launches a kernel whose tasks threads may share: kernel, dimensions, inputs, outputs.
            dt: the time step, s.
            loss_weight: what the power of damping and friction counts for in the losses, s.
            ahead: losses are taken at the velocities that the forces make in this time, s.
        """
        model, state = self._model, self._state
        lanes = 1 if self._device.is_cpu else pairs.GROUP
        launch(
            pairs.add_pair_forces,
            (-(-len(self._points) // pairs.GROUP), lanes),
            [
                *(lanes, self._skin, model.particle_mass, model.particle_inv_mass),
                *(self._near_lower, self._near_upper, self._meetings),
                *(wp.uint64(self._grid.id), self._points, state.v),
                *(model.real(dt), model.real(loss_weight), model.real(ahead), self.culls),
            ],
            [state.f, state.pair_losses],
        )

    def measure(self) -> tuple[float, int, np.ndarray]:
        """Measure overlaps of particles.

        Returns:
            The energy stored in them, J; how many particles overlap others; the greatest overlap of each body, float64
            [body_count], m.
        """
        self._build_grid()
        inputs = [self._skin, wp.uint64(self._grid.id), self._points]
        self._launch(pairs.measure_overlaps, len(self._points), inputs, [self._energies, self._overlaps])
        overlaps = np.zeros(len(self._model.bodies))
        np.maximum.at(overlaps, self._skin.body.numpy(), self._overlaps.numpy())
        return float(self._energies.numpy().sum()), int(np.count_nonzero(self._overlaps.numpy())), overlaps

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device)

    def _build_grid(self) -> None:
        """Sort the particles of the skin into the grid, at their current positions."""
        self._launch(pairs.gather_skin, len(self._points), [self._skin, self._state.x], [self._points])
        # Cells of two balls' width: fewer of them to search than of one, and hardly more balls.
        self._grid.build(self._points, 4.0 * self._skin.greatest_radius)
