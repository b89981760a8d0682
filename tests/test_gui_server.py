"""The server of the page, and parts of the page that need no browser: requests, meshes by colour, arrows, angles."""

from __future__ import annotations

import logging
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from runs import CUBE
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from warpjelly import Scene, Simulator, cli
from warpjelly.errors import EnvironmentFailedError, InputError
from warpjelly.gui.drawing import STEPS, Balls, Edges, Surface
from warpjelly.gui.gizmo import _axes, _quaternion
from warpjelly.gui.objects import angles_of, normal_of
from warpjelly.gui.requests import Requests
from warpjelly.gui.server import LOCAL, served
from warpjelly.gui.session import Session
from warpjelly.gui.surroundings import FIELD_OF_VIEW, PRESETS, look
from warpjelly.polygons import triangulate
from warpjelly.shapes import PARTICLES, Shape


@pytest.fixture
def warpjelly(monkeypatch, capfd):
    """Return a function that runs a command line and gives exit code and stderr."""

    def call(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["warpjelly", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_code:
            cli.main()
        return int(exit_code.value.code or 0), capfd.readouterr().err

    yield call
    logging.getLogger("warpjelly").handlers = []


def test_the_page_is_served_until_interrupted(tmp_path) -> None:
    """Print the address, answer there, and end at Ctrl-C as other commands do."""
    command = [sys.executable, "-c", "from warpjelly.cli import main; main()", "gui", CUBE, "--no-open"]
    with subprocess.Popen(
        [*map(str, command), "--device", "cpu", "-o", str(tmp_path / "out")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("page: http://127.0.0.1:")
        with urllib.request.urlopen(line.split()[1]) as page:
            assert b"<html" in page.read().lower()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (130, "", "error: interrupted\n")


def test_a_taken_port_is_refused(warpjelly) -> None:
    """Say in one line that the port is taken, instead of taking another one."""
    with socket.create_server((LOCAL, 0)) as taken:
        port = taken.getsockname()[1]
        code, err = warpjelly("gui", CUBE, "--no-open", "--port", port)
    assert code == 4
    assert err.count("\n") == 1
    assert f"127.0.0.1:{port}" in err
    with (
        Session(device="cpu") as session,
        pytest.raises(InputError, match="--host nowhere"),
        served(session, host="nowhere.invalid", scenes=Path(), folder=Path()),
    ):
        pass


def test_wrong_input_is_refused(warpjelly, monkeypatch, tmp_path) -> None:
    """Say in one line what is wrong: a scene that is not there, keys of no scene, a missing package."""
    code, err = warpjelly("gui", tmp_path / "none.toml", "--no-open")
    assert (code, err.count("\n")) == (2, 1)
    code, err = warpjelly("gui", "--set", "solver.dt=1", "--no-open")
    assert (code, err.count("\n")) == (2, 1)
    monkeypatch.setitem(sys.modules, "viser", None)
    code, err = warpjelly("gui", CUBE, "--no-open")
    assert (code, err.count("\n")) == (2, 1)
    assert "pip install 'warpjelly[gui]'" in err


def test_requests_are_done_in_order() -> None:
    """Do the last of those that wait, before what is asked for later, and go on after one that fails."""
    done: list[str] = []
    failures: list[tuple[Any, str]] = []
    requests = Requests(lambda client, text: failures.append((client, text)))
    ended = threading.Event()

    def fail() -> None:
        raise InputError("there is no such thing")

    for digits in ("1", "10", "100"):
        requests.ask("a", lambda digits=digits: done.append(digits), key="stiffness", pause=1e3)
    assert requests.awaits("stiffness")
    requests.ask("b", fail)
    requests.ask("c", lambda: done.append("save"))
    requests.ask("d", ended.set)
    assert ended.wait(10.0)
    assert done == ["100", "save"]
    assert failures == [("b", "there is no such thing")]
    assert not requests.awaits("stiffness")
    requests.stop()


class _Node:
    """What viser gives for a node of its scene."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.__dict__.update(options)
        self.removed = False

    def on_drag(self, button: str) -> Any:
        return lambda callback: callback

    def remove(self) -> None:
        self.removed = True


class _Scene:
    """A scene of viser's that only keeps what it is given."""

    add_mesh_simple = add_line_segments = add_point_cloud = _Node


def a_surface() -> tuple[Shape, Any]:
    """Return the surface of a cube, and a sample of it."""
    scene = Scene.model_validate(
        {
            "materials": {"jelly": {}},
            "bodies": [{"type": "cube", "particles_per_edge": 4, "material": "jelly"}],
        }
    )
    sim = Simulator(scene, device="cpu")
    sim.step(3)
    return sim.model.shapes[0], sim.shapes()[0]


def test_colours_are_meshes_that_share_all_triangles() -> None:
    """Find each triangle once, in the mesh of the step that the mean force at the corners of its face falls into."""
    shape, frame = a_surface()
    forces = np.linspace(0.0, 1.0, len(frame.points), dtype=np.float32)
    frame = type(frame)(frame.points, frame.normals, frame.velocities, forces)
    surface = Surface(_Scene(), "/surface", shape, frame, print)
    surface.show(frame, (0.0, 1.0))
    meshes = surface._meshes
    assert len(meshes) == STEPS
    drawn = [mesh.vertices[mesh.faces] for mesh in meshes]
    triangles, faces = triangulate(frame.points, shape.counts, shape.corners)
    face_means = [np.mean(forces[corners]) for corners in np.split(shape.corners, np.cumsum(shape.counts)[:-1])]
    # Indices into the table are rounded, by half of one at most.
    tolerance = 0.5 / 255 + 1.0 / 256
    for step, corners in enumerate(drawn):
        for triangle in corners if np.ptp(corners) > 0 else []:
            where = [np.flatnonzero((frame.points == corner).all(axis=1)) for corner in triangle]
            means = [
                face_means[face]
                for each, face in zip(triangles, faces, strict=True)
                if all(a in b for a, b in zip(each, where, strict=True))
            ]
            assert any(step / STEPS - tolerance <= mean <= (step + 1) / STEPS + tolerance for mean in means)
    shown = np.concatenate([corners for corners in drawn if np.ptp(corners) > 0])
    assert len(shown) == len(triangles)
    key = lambda all_of_them: sorted(map(bytes, np.ascontiguousarray(all_of_them)))  # noqa: E731
    assert key(shown) == key(frame.points[triangles])
    surface.show(frame, None)
    assert all(mesh.removed for mesh in meshes)
    assert len(surface._meshes) == 1


def test_what_was_just_added_is_not_yet_in_a_snapshot(tmp_path) -> None:
    """Draw a snapshot of before something was added: it is chosen, and shown as soon as it is there."""
    with (
        Session(device="cpu") as session,
        served(session, scenes=tmp_path, folder=tmp_path) as (page, _),
    ):
        old = session.latest()
        page.bodies._set_moving(True)
        page.objects._set_moving(True)
        page.bodies._add_or_delete(None, "Add")
        page.objects._create(None, "Sphere")
        for panel in (page.bodies, page.objects):
            panel.refresh(old)
            panel.draw(old)
            panel.follow(old)
        assert (page.bodies.chosen, page.objects.chosen) == (session.scene.bodies[-1].name, "sphere")
        new = session.settle()
        for panel in (page.bodies, page.objects):
            panel.refresh(new)
            panel.draw(new)
        assert (page.bodies._which.value, page.objects._which.value) == (page.bodies.chosen, page.objects.chosen)
        assert page.failure is None


def test_an_empty_list_of_scenes_says_why(tmp_path) -> None:
    """Find no scene to open: the page says where it looked, until there is one."""
    with (
        Session(device="cpu") as session,
        served(session, scenes=tmp_path / "scenes", folder=tmp_path) as (page, _),
    ):
        assert str(tmp_path / "scenes") in page.scenes._missing.content
        session.save(tmp_path / "one.toml")
        page.scenes.refresh(session.settle())
        assert page.scenes._missing.content == ""
        assert page.scenes._found.options == (str(tmp_path / "one.toml"),)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 16 / 9, 3.0])
@pytest.mark.parametrize("preset", PRESETS)
def test_a_camera_sees_all_in_windows_of_any_width(preset, aspect) -> None:
    """Look at the corners of a box: each is within the field of view, whose height is given, on all sides."""
    corners = np.array(list(np.ndindex(2, 2, 2))) * [2.0, 1.0, 1.5] + [3.0, 0.5, -1.0]
    position, target = look(preset, "Y", corners, aspect)
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 1.0, 0.0], backward)
    right /= np.linalg.norm(right)
    x, y, z = np.stack([right, np.cross(backward, right), backward]) @ (corners - position).T
    slope = np.tan(FIELD_OF_VIEW / 2)
    assert np.all(np.abs(y) < -slope * z)
    assert np.all(np.abs(x) < -slope * aspect * z)


def test_edges_and_balls_are_drawn_once() -> None:
    """Draw each edge of the faces of a cube once, and no more balls than a browser draws in time."""
    shape, frame = a_surface()
    edges = Edges(_Scene(), "/edges", shape, frame)
    # A cube of 3 x 3 x 3 cells has 54 faces, each with 4 edges that two faces share.
    assert len(edges._ends) == 54 * 4 // 2
    lengths = np.linalg.norm(np.diff(frame.points[edges._ends], axis=1), axis=2)
    np.testing.assert_allclose(lengths, 1 / 3, rtol=1e-3)
    points = np.zeros((60_000, 3), np.float32)
    many = Shape("a", PARTICLES, np.zeros((60_000, 1), np.int32), np.ones((60_000, 1), np.float32), width=0.1)
    balls = Balls(_Scene(), "/balls", many, type(frame)(points, points, points, points[:, 0]))
    assert balls.left_out == 10_000


def test_arrows_turn_as_their_axes() -> None:
    """Get axes back from their quaternion, also where some of its components are 0."""
    generator = np.random.default_rng(1)
    turns = [np.linalg.qr(generator.normal(size=(3, 3)))[0] for _ in range(50)]
    turns = [turn * np.linalg.det(turn) for turn in turns]
    for axes in [*turns, np.eye(3), np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])]:
        np.testing.assert_allclose(_axes(_quaternion(axes)), axes, atol=1e-12)


@pytest.mark.parametrize("up", [1, 2])
def test_angles_stand_for_a_direction(up) -> None:
    """Get tilt and heading back from the direction that they stand for; no tilt is upwards."""
    for tilt, heading in [(30.0, 0.0), (90.0, 200.0), (179.0, 359.0)]:
        np.testing.assert_allclose(angles_of(3 * normal_of(tilt, heading, up), up), (tilt, heading), atol=1e-9)
    np.testing.assert_allclose(normal_of(0.0, 77.0, up), np.eye(3)[up], atol=1e-12)


def test_a_port_is_found_where_none_is_given(tmp_path) -> None:
    """Serve two pages at once, at different ports."""
    with (
        Session(device="cpu") as session,
        served(session, scenes=tmp_path, folder=tmp_path) as (_, first),
        served(session, scenes=tmp_path, folder=tmp_path) as (_, second),
    ):
        assert first != second
        port = int(first.rpartition(":")[2])
        with pytest.raises(EnvironmentFailedError), served(session, port=port, scenes=tmp_path, folder=tmp_path):
            pass


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        (None, True),
        ("http://127.0.0.1:{port}", True),
        ("http://localhost:{port}", False),
        ("http://127.0.0.1:1", False),
        ("https://elsewhere.example", False),
        ("http://elsewhere.example:{port}", False),
        ("null", False),
    ],
)
def test_pages_of_other_sites_are_refused(tmp_path, origin, allowed) -> None:
    """Let only the own page connect: any site that somebody looks at could otherwise change and write things here."""
    with Session(device="cpu") as session, served(session, scenes=tmp_path, folder=tmp_path) as (_, address):
        port = address.rpartition(":")[2]
        options = {"origin": None if origin is None else origin.format(port=port), "subprotocols": ["viser-v0"]}
        if allowed:
            with connect(address.replace("http", "ws", 1), **options) as connection:
                assert connection.subprotocol == "viser-v0"
        else:
            with pytest.raises(InvalidStatus, match="HTTP 403"):
                connect(address.replace("http", "ws", 1), **options)
        # Nor where a name of another site was given the address of this machine.
        host = f"elsewhere.example:{port}"
        with pytest.raises(InvalidStatus, match="HTTP 403"):
            connect(f"ws://{host}", origin=f"http://{host}", sock=socket.create_connection((LOCAL, int(port))))
