"""The page to look around in: plays from disk in a browser, shows what the stage shows, and stays small."""

from __future__ import annotations

import base64
import io
import json
import re
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import opened
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt
from stages import cube_surface, make_scene, write_stage

from warpjelly.colors import SRGB_TABLE, srgb_from_linear
from warpjelly.errors import InputError
from warpjelly.looks import Look, Texture
from warpjelly.previews.legends import Legend, legend_of
from warpjelly.previews.preview import render_preview
from warpjelly.stage.stagefiles import open_stage
from warpjelly.stage.usdlooks import define_look


def contents(page: Path) -> tuple[dict[str, Any], bytes]:
    """Return what a page plays: its description and its arrays."""
    text = page.read_text()
    stage, arrays = (re.search(rf'id="{name}">(.*?)</script>', text, re.DOTALL)[1] for name in ("stage", "arrays"))
    return json.loads(stage), zlib.decompress(base64.b64decode(arrays))


def unpacked(page: Path) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return triangles, places [frame_count, point_count, 3], m, and sRGB colours of each shape of a page."""
    stage, data = contents(page)
    file = io.BytesIO(data)

    def array(dtype: str, *shape: int) -> np.ndarray:
        return np.frombuffer(file.read(int(np.prod(shape)) * np.dtype(dtype).itemsize), dtype).reshape(shape)

    found = []
    for shape in stage["shapes"]:
        placed, colored = (len(stage["frames"]) if shape[key] else 1 for key in ("moves", "recolors"))
        triangles = array("<u4", shape["triangles"], 3)
        low, high = (array("u1", placed, shape["points"], 3).astype(np.uint16) for _ in range(2))
        places = np.cumsum(low | high << 8, axis=0, dtype=np.uint16) / 65535
        indices = np.cumsum(array("u1", colored, shape["points"]), axis=0, dtype=np.uint8)
        palette = np.array(shape["palette"]).reshape(-1, 3) / 255
        found.append((triangles, places * shape["size"] + shape["low"], palette[indices]))
    assert not file.read()
    return found


@pytest.mark.parametrize("color", ["indexed", "rgb"])
def test_page_holds_the_stage(tmp_path: Path, color: str) -> None:
    """Keep every place to 16 bits of the motion, every colour to 8 bits, and all of the surface."""
    path, page = write_stage(tmp_path / "stage.usdc", make_scene(output={"color": color})), tmp_path / "r.html"
    render_preview(path, page, frames=[1, 9], every=2)
    stage = open_stage(path)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/bodies/cube/surface"))
    jelly, floor = unpacked(page)
    frames = [1, 3, 5, 7, 9]
    points = np.array([mesh.GetPointsAttr().Get(frame) for frame in frames])
    step = np.ptp(points.reshape(-1, 3), axis=0).max() / 65535
    # Half a step of rounding, and that of float32.
    np.testing.assert_allclose(jelly[1], points, atol=0.51 * step + 1e-6)
    nearest = [np.abs(SRGB_TABLE - color).max(axis=1).min() for color in np.unique(jelly[2].reshape(-1, 3), axis=0)]
    assert max(nearest) < 0.51 / 255 + 1e-6
    assert len(nearest) > 20
    a, b, c = np.moveaxis(jelly[1][0][jelly[0]], 1, 0)
    # The volume inside the surface, from its triangles: they are all there and face outwards.
    assert np.sum(np.cross(a, b) * c) / 6 == pytest.approx(np.prod(np.ptp(points[0], axis=0)), rel=1e-3)
    assert floor[1].shape == (1, 4, 3)


def test_page_and_pictures_say_what_the_colors_mean(tmp_path: Path) -> None:
    """Write the range of forces and the colours of springs into the page as legends of pictures have them."""
    scene = make_scene(output={"force_range": (0.0, 220.0)})
    path = write_stage(tmp_path / "stage.usdc", scene, frames=2)
    stage = Usd.Stage.Open(str(path))
    red = Gf.Vec3d(1.0, 0.0, 0.0)
    stage.GetDefaultPrim().SetCustomDataByKey("legend:springs", {"bend": red})
    stage.Save()
    expected = Legend("0", "220", "force, N", {"bend": [255, 0, 0]})
    assert legend_of(stage) == expected
    render_preview(path, tmp_path / "review.html")
    assert contents(tmp_path / "review.html")[0]["legend"].items() >= asdict(expected).items()


def test_page_stays_small(tmp_path: Path) -> None:
    """Take at most 7 bytes for a point in a frame, and a third more in text."""
    path, page = write_stage(tmp_path / "stage.usdc", meshes=[cube_surface(count=30)]), tmp_path / "r.html"
    render_preview(path, page)
    points = 30**3 - 28**3
    assert page.stat().st_size < 50_000 + points * 10 * 7 * 4 / 3


def test_page_shows_the_models_own_colors(tmp_path: Path) -> None:
    """Draw what has a material in its colour, of a texture the mean, and the rest in those of its points."""
    from PIL import Image

    path, page, image = write_stage(tmp_path / "stage.usdc"), tmp_path / "r.html", io.BytesIO()
    Image.fromarray(np.array([[[0, 100, 50]], [[255, 100, 150]]], np.uint8)).save(image, "PNG")
    stage = open_stage(path)
    mesh = stage.GetPrimAtPath("/World/bodies/cube/surface")
    for faces, value in ((range(16), (0.2, 0.5, 0.8)), (range(16, 32), Texture("t.png", image.getvalue(), srgb=True))):
        name = f"part{faces[0]}"
        look = define_look(
            stage, mesh.GetPath().AppendChild(f"m{name}"), Look(name, {"diffuseColor": value}), tmp_path / "textures"
        )
        subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset(name, Vt.IntArray(list(faces)))
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(look)
    stage.Save()
    render_preview(path, page, frames=[0, 1])
    jelly = next(shape for shape in contents(page)[0]["shapes"] if shape["kind"] == "surface")
    assert [part["count"] for part in jelly["parts"]] == [32, 32, 2 * (96 - 32)]
    blue, mean, own = (part["color"] for part in jelly["parts"])
    np.testing.assert_allclose(blue, srgb_from_linear(np.array([0.2, 0.5, 0.8])))
    np.testing.assert_allclose(mean, np.array([127.5, 100, 100]) / 255)
    assert own is None


@pytest.mark.parametrize(("sharp", "points", "smooth"), [(1, 9, True), (12, 8, False)])
def test_few_edges_split_points_and_many_are_shaded_flat(tmp_path: Path, sharp: int, points: int, smooth: bool) -> None:
    """Draw a box of triangles whose corners have normals of their own: one of them, or as many as triangles."""
    corners = np.array(
        [0, 1, 3, 0, 3, 2, 4, 7, 5, 4, 6, 7, 0, 5, 1, 0, 4, 5, 2, 3, 7, 2, 7, 6, 0, 2, 6, 0, 6, 4, 1, 7, 3, 1, 5, 7]
    )
    path, page = write_stage(tmp_path / "stage.usdc"), tmp_path / "r.html"
    stage = open_stage(path)
    box = UsdGeom.Mesh.Define(stage, "/World/box")
    box.CreateSubdivisionSchemeAttr("none")
    box.CreatePointsAttr([tuple(place) for place in np.ndindex(2, 2, 2)])
    box.CreateExtentAttr([(0, 0, 0), (1, 1, 1)])
    box.CreateFaceVertexCountsAttr([3] * 12)
    box.CreateFaceVertexIndicesAttr(corners.tolist())
    box.CreateDisplayColorAttr([(1, 0, 0)])
    normals = UsdGeom.PrimvarsAPI(box).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "faceVarying")
    normals.Set([(0, 0, 1)] * 20)
    # Beside the normals of the points there is another one for a corner of some triangles.
    own = np.where(np.arange(36) % 3 + 36 * (np.arange(36) // 3 >= sharp) == 0, 8 + np.arange(36) // 3, corners)
    normals.SetIndices(Vt.IntArray(own.tolist()))
    stage.Save()
    render_preview(path, page)
    drawn = contents(page)[0]["shapes"]
    shape = next(shape for shape in drawn if shape["triangles"] == 12)
    assert (shape["points"], shape["smooth"]) == (points, smooth)
    triangles, places, _ = unpacked(page)[drawn.index(shape)]
    np.testing.assert_allclose(places[0][triangles.ravel()], np.array(list(np.ndindex(2, 2, 2)))[corners], atol=1e-6)


def test_too_much_for_a_page_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Say how much it is, and what thins it."""
    monkeypatch.setattr("warpjelly.previews.review.MAX_BYTES", 1000)
    with pytest.raises(InputError, match=r"102 points in 10 frames .* --every"):
        render_preview(write_stage(tmp_path / "stage.usdc"), tmp_path / "r.html")
    assert not (tmp_path / "r.html").exists()


def colorful(picture: bytes) -> np.ndarray:
    """Return the pixels of a screenshot that show jelly, bool [height, width]; without bar and legend."""
    from PIL import Image

    with Image.open(io.BytesIO(picture)) as image:
        return np.ptp(np.asarray(image.convert("RGB"))[:300] / 255, axis=2) > 0.25


@pytest.mark.browser
def test_page_plays_from_disk(tmp_path: Path) -> None:
    """Play, pause, scrub and orbit in a browser, without a complaint of its console and without a network."""
    colliders = [
        {"name": "ball", "type": "sphere", "center": [1.5, 0.5, 0.0], "radius": 0.3},
        {"name": "room", "type": "box", "size": [6.0, 6.0, 6.0]},
    ]
    path = write_stage(tmp_path / "stage.usdc", make_scene(colliders=colliders, output={"show": ["surface"]}))
    render_preview(path, tmp_path / "r.html")
    with opened(tmp_path / "r.html") as (page, complaints):
        page.wait_for_function("byId('time').textContent !== ''")
        shown = page.locator("#time")
        page.wait_for_function("player.frame >= 2")
        page.keyboard.press("Space")
        assert not page.evaluate("player.playing")
        views = []
        for frame in (0, 9):
            page.locator("#scrub").fill(str(frame))
            page.wait_for_function(f"player.frame === {frame} && !player.stale")
            assert f"{frame / 24:.3f} s" in shown.text_content()
            views.append(colorful(page.screenshot()))
        first, last = (np.argwhere(view) for view in views)
        # The body sinks, flattens and moves along x; it fills a good part of the picture, in the colours of jelly.
        assert min(len(first), len(last)) > 2000
        assert (views[0] != views[1]).sum() > 1000
        page.mouse.move(300, 150)
        page.mouse.down()
        page.mouse.move(420, 180, steps=3)
        page.mouse.up()
        page.wait_for_function("!player.stale")
        assert (colorful(page.screenshot()) != views[1]).sum() > 500
        page.keyboard.press("ArrowLeft")
        page.wait_for_function("player.frame === 8")
        assert complaints == []


@pytest.mark.browser
def test_page_fits_a_phone(tmp_path: Path) -> None:
    """Leave room for all controls of a narrow window, and zoom with two fingers as far as they part."""
    render_preview(write_stage(tmp_path / "stage.usdc"), tmp_path / "r.html")
    with opened(tmp_path / "r.html") as (page, complaints):
        page.set_viewport_size({"width": 390, "height": 700})
        page.wait_for_function("byId('time').textContent !== ''")
        title, tips, scrub = (page.locator(name).bounding_box() for name in ("#title", "#help", "#scrub"))
        assert title["y"] + title["height"] <= tips["y"]
        assert scrub["width"] > 200
        fingers = page.context.new_cdp_session(page)

        def touch(kind: str, *apart: int) -> None:
            points = [{"x": 195 + side * apart[0], "y": 300, "id": side} for side in (-1, 1)] if apart else []
            fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        target, before = page.evaluate("[camera.target, Math.hypot(...camera.offset)]")
        touch("touchStart", 40)
        touch("touchMove", 60)
        touch("touchMove", 80)
        touch("touchEnd")
        page.wait_for_function(f"Math.hypot(...camera.offset) < {0.51 * before}")
        now, distance = page.evaluate("[camera.target, Math.hypot(...camera.offset)]")
        assert distance == pytest.approx(before / 2)
        # The fingers move one after the other; with the first one the middle moves by 10 of 700 pixels, and back again.
        np.testing.assert_allclose(now, target, rtol=0, atol=0.01 * before)
        assert complaints == []
