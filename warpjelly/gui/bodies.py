"""The tab of the bodies: what they are, where they are, what they are made of, and what is shown of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..meshes import EXTENSIONS, EXTRA_EXTENSIONS
from ..scene import DEFAULT_CELL_SIZE, DEFAULT_PARTICLE_MASS, AnyBody, CubeBody, ModelBody, VoxelsBody
from ..shapes import PARTICLES, SPRINGS, SURFACE
from .controls import Controls, Form, Panel, note
from .gizmo import Gizmo
from .session import Session
from .snapshot import Snapshot
from .view import View

# Shapes of voxels to choose from, seen from the front, and how many jelly cubes deep they are.
PATTERNS = {
    "U": ("#..#", "#..#", "####"),
    "T": ("###", ".#.", ".#."),
    "H": ("#.#", "###", "#.#"),
    "arch": ("####", "#..#", "#..#"),
    "ring": ("###", "#.#", "###"),
    "stairs": ("#...", "##..", "###.", "####"),
    "cross": (".#.", "###", ".#."),
    "bar": ("######",),
}
_DEPTH = 2
_FORMATS = (*EXTENSIONS, *EXTRA_EXTENSIONS)
_DRAWN = "as in the scene"
# What a model becomes at first: jelly cubes along its longest edge, and how long that is, m.
_RESOLUTION, _EXTENT = 12, 1.0
_SURFACES = ("voxels", "smooth", "model", "none")
# Units of stiffness and damping by law.
_UNITS = {"strain": ("N", "N s"), "hooke": ("N/m", "N s/m")}
_SPRINGS = {
    "structural": "springs along the edges of cells",
    "shear": "springs along the diagonals of cells",
    "bend": "springs to the particles after the next",
}


class BodiesPanel(Panel):
    """Controls of bodies.

    Args:
        controls: what makes them.
        session: whose bodies they are.
        view: what shows them.
        gizmo: makes arrows, given what moves the body.
        folders: with models to choose from.
        again: has everything shown again.
    """

    def __init__(
        self,
        controls: Controls,
        session: Session,
        view: View,
        gizmo: Callable[[Callable[[np.ndarray, np.ndarray], None]], Gizmo],
        folders: Sequence[Path],
        again: Callable[[], None],
    ) -> None:
        self._controls, self._session, self._view, self._folders = controls, session, view, folders
        self._again = again
        self.chosen = ""
        # The same as soon as it is there: a body that was just added is not yet in a snapshot.
        self._shown_body = ""
        self._gizmo = gizmo(lambda place, _: session.teleport(self.chosen, to=place.tolist()))
        self._moving = False
        self._which = controls.choice("Body", (), self.choose, hint="What all below is about")
        controls.buttons("Bodies", ("Add", "Delete"), self._add_or_delete, hint="Add a cube; delete the body")
        with controls.folder("Shape"):
            self._kind = controls.choice(
                "Made from", ("cube", "voxels", "model"), self._set_kind, hint="What the body is made from"
            )
            self._shape = Form(controls, controls.folder(None))
            upload = controls.gui.add_upload_button(
                "Upload a model", hint=f"Make the body of it: {' '.join(_FORMATS)}", icon="upload"
            )
            controls.on_upload(upload, self._take_upload)
        with controls.folder("Place"):
            self._place = controls.vector(
                "Centre, m",
                lambda place: session.teleport(self.chosen, to=place),
                hint="Of mass. A body that is put elsewhere stops",
            )
            controls.switch("Arrows", self._set_moving, hint="Drag the body by arrows in the view")
        with controls.folder("Material") as material:
            self._material = Form(controls, material)
        with controls.folder("Show"):
            self._surface = controls.choice(
                "Surface",
                _SURFACES,
                self._show_surface,
                hint="The faces of cells, the same without steps, the model that it was made from, or nothing",
            )
            self._edges = controls.switch("Edges of cells", self._set_edges, hint="Draw the edges of its faces")
            self._springs = controls.switch("Springs", lambda on: self._show(SPRINGS, on), hint="Draw springs")
            self._particles = controls.switch("Particles", lambda on: self._show(PARTICLES, on), hint="Draw particles")
            self._note = controls.gui.add_html("")
            controls.switch("Colours of forces", self._set_colors, hint="Or one colour", on=True)
            self._legend = controls.gui.add_html("")

    def refresh(self, snapshot: Snapshot) -> None:
        """Show what the set-up says."""
        scene = snapshot.scene
        names = [str(body.name) for body in scene.bodies]
        wanted = [str(body.name) for body in self._session.scene.bodies]
        if (chosen := self.chosen) not in wanted:
            self.chosen = chosen = wanted[0]
        self._shown_body = chosen if chosen in names else names[0]
        body = scene.bodies[names.index(self._shown_body)]
        self._controls.offer(self._which, names, self._shown_body)
        kinds = tuple(dict.fromkeys(("cube", "voxels", "model", body.type)))
        self._controls.offer(self._kind, kinds, body.type)
        # Models at hand may be others when a model was uploaded.
        file = body.file if isinstance(body, ModelBody) else None
        self._shape.show((body.type, file), lambda: self._make_shape(body), snapshot)
        material = scene.materials[body.material]
        kind = (material.law, material.density is not None)
        self._material.show(kind, lambda: self._make_material(*kind), snapshot)
        self._controls.put(self._surface, scene.output.surface if SURFACE in scene.output.show else "none")
        self._controls.put(self._springs, SPRINGS in scene.output.show)
        self._controls.put(self._particles, PARTICLES in scene.output.show)

    def follow(self, snapshot: Snapshot) -> None:
        """Show where the body is, and what the colours mean."""
        if (center := snapshot.centers.get(self._shown_body)) is None:
            return
        self._controls.put(self._place, tuple(np.round(center, 3).tolist()))
        self._legend.content = self._view.legend()
        left_out = self._view.left_out
        self._note.content = note(f"{left_out:,} springs and particles are not drawn") if left_out else ""

    def draw(self, snapshot: Snapshot) -> None:
        """Put the arrows where the body is."""
        center = snapshot.centers.get(self._shown_body) if self._moving else None
        self._gizmo.show(center, size=0.0 if center is None else 0.6 * self._size(snapshot))

    def choose(self, name: str) -> None:
        """Let all below be about a body."""
        self.chosen = name
        self._again()

    # What is asked for.

    def _add_or_delete(self, client: Any, which: str) -> None:
        if which == "Delete":
            self._session.delete_body(self.chosen)
            return
        snapshot = self._session.latest()
        up = snapshot.scene.up
        # Above all that is there.
        points = np.concatenate([frame.points for frame in snapshot.frames])
        position = [0.0, 0.0, 0.0]
        position[up] = float(points[:, up].max()) + 0.75
        self.chosen = self._session.add_body({"type": "cube", "size": 1.0, "position": position})

    def _set_kind(self, kind: str) -> None:
        body = self._body()
        if kind == body.type:
            return
        tables: dict[str, dict[str, Any]] = {
            "cube": {},
            "voxels": {"layers": layers_of("U"), "cell_size": 0.25},
            "model": {"resolution": _RESOLUTION, "fit": _EXTENT},
        }
        table = {"type": kind, **tables[kind]}
        if kind == "model":
            models = models_in(self._folders)
            if not models:
                raise InputError("no model to choose from: upload one, or start where scenes/models is")
            table["file"] = str(next(iter(models.values())))
        self._session.replace_body(self.chosen, table)

    def _take_upload(self, name: str, content: bytes) -> None:
        body = self._body()
        resolution = body.resolution if isinstance(body, ModelBody) else _RESOLUTION
        extent = (body.fit or _EXTENT) if isinstance(body, ModelBody) else _EXTENT

        path = self._session.upload(name, content)
        table = {"type": "model", "file": str(path), "resolution": resolution, "fit": extent}
        self._session.replace_body(self.chosen, table)

    def _set_moving(self, on: bool) -> None:
        self._moving = on
        self._again()

    def _set_edges(self, on: bool) -> None:
        self._view.edged = on
        self._again()

    def _set_colors(self, on: bool) -> None:
        self._view.colored = on
        self._again()

    def _show_surface(self, surface: str) -> None:
        if surface == "none":
            self._show(SURFACE, False)
            return
        shown = self._shown(SURFACE, True)
        self._session.change_all({"output.surface": surface, "output.show": shown})

    def _show(self, what: str, on: bool) -> None:
        self._session.change("output.show", self._shown(what, on))

    def _shown(self, what: str, on: bool) -> list[str]:
        """Return what is shown when something is, or is not, too."""
        shown = set(self._session.scene.output.show) - {what} | ({what} if on else set())
        return [each for each in (SURFACE, SPRINGS, PARTICLES) if each in shown]

    def _change(self, key: str) -> Callable[[Any], None]:
        """Return what changes a key of the body."""
        return lambda value: self._session.change(f"bodies.{self.chosen}.{key}", value)

    def _change_material(self, key: str, factor: float = 1.0) -> Callable[[float], None]:
        """Return what changes a key of the body's material, given in units that are some times smaller."""
        return lambda value: self._session.change_material(self.chosen, {key: value / factor})

    def _body(self) -> AnyBody:
        return next(body for body in self._session.scene.bodies if body.name == self.chosen)

    # Controls that depend on what the body is.

    def _make_shape(self, body: AnyBody) -> None:
        controls, bind = self._controls, self._shape.bind
        if isinstance(body, CubeBody):
            bind(
                controls.whole(
                    "Particles per edge", self._change("particles_per_edge"), hint="8 are 512 in all", low=2, high=48
                ),
                lambda snapshot: self._of(snapshot).particles_per_edge,
            )
            bind(
                controls.number("Edge, m", self._change("size"), hint="Length of an edge", step=0.1, low=0.01),
                lambda snapshot: self._of(snapshot).size,
            )
        elif isinstance(body, VoxelsBody):
            bind(
                controls.choice("Pattern", (_DRAWN, *PATTERNS), self._set_pattern, hint="Seen from the front"),
                lambda snapshot: pattern_of(self._of(snapshot)),
            )
            bind(
                controls.number("Cube, m", self._change("cell_size"), hint="Edge of a jelly cube", step=0.05, low=0.01),
                lambda snapshot: self._of(snapshot).cell_size or DEFAULT_CELL_SIZE,
            )
            bind(
                controls.whole(
                    "Particles per cube edge", self._change("particles_per_edge"), hint="2 are 8 a cube", low=2, high=8
                ),
                lambda snapshot: self._of(snapshot).particles_per_edge,
            )
        elif isinstance(body, ModelBody):
            models = models_in(self._folders)
            here = {body.file.name: body.file, **models}
            bind(
                controls.choice(
                    "Model", tuple(here), lambda name: self._change("file")(str(here[name])), hint="Models at hand"
                ),
                lambda snapshot: self._of(snapshot).file.name,
            )
            bind(
                controls.whole(
                    "Resolution", self._change("resolution"), hint="Jelly cubes along the longest edge", low=1, high=64
                ),
                lambda snapshot: self._of(snapshot).resolution,
            )
            bind(
                controls.number("Extent, m", self._set_extent, hint="Of its longest edge", step=0.1, low=0.01),
                lambda snapshot: self._extent(snapshot),
            )

    def _make_material(self, law: str, dense: bool) -> None:
        def number(label: str, key: str, hint: str, step: float, factor: float = 1.0) -> None:
            def read(snapshot: Snapshot) -> float:
                found: Any = snapshot.scene.materials[self._of(snapshot).material]
                for part in key.split("."):
                    found = getattr(found, part)
                return round(factor * (found if found is not None else _UNSAID[key]), 9)

            self._material.bind(
                self._controls.number(label, self._change_material(key, factor), hint=hint, step=step, low=0.0), read
            )

        if dense:
            number("Density, kg/m³", "density", "Mass of a volume", 10.0)
        else:
            number("Particle, g", "particle_mass", "Mass of each particle", 1.0, 1e3)
        if law == "young":
            number("Young's modulus, kPa", "youngs_modulus", "Force over area for a stretch by 100 %", 1.0, 1e-3)
            number("Damping, ms", "damping_time", "Damping over stiffness", 0.1, 1e3)
            return
        stiffness, damping = _UNITS[law]
        for kind, what in _SPRINGS.items():
            number(f"{kind.capitalize()}, {stiffness}", f"{kind}.stiffness", f"Stiffness of {what}", 10.0)
            number(f"  damping, {damping}", f"{kind}.damping", f"Damping of {what}", 0.05)

    def _of(self, snapshot: Snapshot) -> Any:
        """Return the body as a snapshot's set-up has it."""
        return next(body for body in snapshot.scene.bodies if body.name == self._shown_body)

    def _set_pattern(self, pattern: str) -> None:
        if pattern != _DRAWN:
            keys = {"layers": layers_of(pattern), "file": None, "regions": []}
            self._session.change_all({f"bodies.{self.chosen}.{key}": value for key, value in keys.items()})

    def _set_extent(self, extent: float) -> None:
        self._session.change_all({f"bodies.{self.chosen}.fit": extent, f"bodies.{self.chosen}.scale": None})

    def _extent(self, snapshot: Snapshot) -> float:
        """Return the extent of a model as the set-up says it, or as it was made."""
        fit = self._of(snapshot).fit
        return fit if fit is not None else round(self._size(snapshot), 3)

    def _size(self, snapshot: Snapshot) -> float:
        """Return the largest extent of the body as it is, m."""
        shown = zip(snapshot.shapes, snapshot.frames, strict=True)
        points = np.concatenate([frame.points for shape, frame in shown if shape.body == self._shown_body])
        return float(np.ptp(points, axis=0).max())


# What materials say where they say nothing.
_UNSAID = {"particle_mass": DEFAULT_PARTICLE_MASS, "damping_time": 5e-4}


def models_in(folders: Sequence[Path]) -> dict[str, Path]:
    """Return the model files in folders by their names; of two with the same name, that of the last folder."""
    found = [path for folder in folders if folder.is_dir() for path in sorted(folder.iterdir())]
    return {path.name: path.absolute() for path in found if path.suffix.lower() in _FORMATS and path.is_file()}


def layers_of(pattern: str) -> list[list[str]]:
    """Return the layers of a pattern, as scenes have them, from the bottom up."""
    return [[row] * _DEPTH for row in reversed(PATTERNS[pattern])]


def pattern_of(body: VoxelsBody) -> str:
    """Return the pattern that a body of voxels has, if it is one of these."""
    return next((pattern for pattern in PATTERNS if layers_of(pattern) == body.layers), _DRAWN)
