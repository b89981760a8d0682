"""Make the pictures of the README: run each scene and show some of its frames side by side, and one as a movie.

python scenes/pictures/make_pictures.py [SCENE ...]

"sheet" is the page of a batch, in the Chromium that is installed.
"""

import shutil
import sys
import tempfile
from pathlib import Path

from PIL import Image

import warpjelly as wj
from warpjelly.previews.preview import render_preview

HERE = Path(__file__).parent
SIZE, MOVIE_SIZE = (420, 236), (800, 450)
GAP = 4
SHEET_SIZE = {"width": 1100, "height": 920}
# The frames that tell a scene's story.
FRAMES = {
    "tree_drop": [0, 25, 38, 78, 299],
    "jello_cube": [0, 30, 64, 200, 299],
    "cube_on_sphere": [0, 36, 56, 76, 130],
    "u_on_sphere": [0, 33, 45, 80, 239],
    "coupler_drop": [0, 6, 13, 30, 119],
    "creature_drop": [0, 8, 13, 24, 149],
    "two_materials": [0, 14, 20, 28, 119],
    "dessert_shot": [1001, 1003, 1005, 1008, 1036],
    "three_networks": [0, 20, 30, 60, 179],
    "pile": [0, 22, 36, 60, 119],
    "falling_cloth": [0, 17, 24, 35, 149],
}
# The scene that the README starts with moves: its first and last frame.
MOVIES = {"tree_drop": [0, 239]}
# The same moment of several scenes.
COMPARED = {"couplers": (["coupler_7", "coupler_8", "coupler_drop", "coupler_40"], 13)}


def show(scene: str, frames: list[int], picture: Path) -> None:
    """Run a scene and write some of its frames into a PNG, and all beside it where the scene is one of the movies."""
    with tempfile.TemporaryDirectory() as folder:
        wj.simulate(wj.load_scene(HERE.parent / f"{scene}.toml"), output=folder)
        render_preview(Path(folder), picture, frames=frames, size=SIZE, force=True)
        if scene in MOVIES:
            movie = picture.with_suffix(".webp")
            render_preview(Path(folder), movie, frames=MOVIES[scene], every=2, size=MOVIE_SIZE, force=True)


def main(chosen: list[str]) -> None:
    """Write the chosen pictures beside this file; all of them if none is chosen."""
    for name, frames in FRAMES.items():
        if not chosen or name in chosen:
            show(name, frames, HERE / f"{name}.png")
            print(HERE / f"{name}.png")
    for name, (scenes, frame) in COMPARED.items():
        if not chosen or name in chosen:
            with tempfile.TemporaryDirectory() as folder:
                panels = [Path(folder, f"{scene}.png") for scene in scenes]
                for scene, panel in zip(scenes, panels, strict=True):
                    show(scene, [frame], panel)
                side_by_side([Image.open(panel) for panel in panels]).save(HERE / f"{name}.png")
            print(HERE / f"{name}.png")
    if not chosen or "sheet" in chosen:
        show_sheet(HERE / "sheet.png")
        print(HERE / "sheet.png")


def show_sheet(picture: Path) -> None:
    """Do the parameter study and write its page, as a browser shows it, into a PNG."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        output = Path(folder) / "bounce"
        wj.run_batch(HERE.parent / "sweeps" / "bounce.toml", output=output, pictures=True)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport=SHEET_SIZE, color_scheme="light")
        page.goto((output / "index.html").as_uri())
        page.select_option("#y", label="bounce")
        page.screenshot(path=picture)
        browser.close()
    # Few colours make a small file.
    Image.open(picture).convert("RGB").quantize(256).save(picture, optimize=True)


def side_by_side(panels: list[Image.Image]) -> Image.Image:
    """Return pictures of one size beside each other."""
    width, height = panels[0].size
    whole = Image.new("RGB", (len(panels) * (width + GAP) - GAP, height), "white")
    for i, panel in enumerate(panels):
        whole.paste(panel, (i * (width + GAP), 0))
    return whole


if __name__ == "__main__":
    main(sys.argv[1:])
