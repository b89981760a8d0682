"""Take the README's pictures of the page in a browser: ``python scenes/pictures/make_page_pictures.py``."""

from __future__ import annotations

import io
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

from warpjelly import load_scene
from warpjelly.gui.server import served
from warpjelly.gui.session import Session

HERE = Path(__file__).parent
SIZE = {"width": 1180, "height": 680}
# Without a GPU a browser takes a while for a frame, s.
FRAME = 6.0
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def main() -> None:
    """Take all pictures."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        for name, scene, seconds, tab in (
            ("page_play", "u_on_sphere", 0.75, "Play"),
            ("page_bodies", "tree_drop", 0.45, "Bodies"),
            ("page_objects", "corner_throw", 0.4, "Objects"),
        ):
            with (
                Session(load_scene(HERE.parent / f"{scene}.toml"), device="cpu") as session,
                served(session, scenes=HERE.parent, folder=Path(folder)) as (_, address),
            ):
                page = browser.new_page(viewport=SIZE)
                page.goto(address)
                page.get_by_role("tab", name="Bodies").wait_for(timeout=60_000)
                play(session, seconds)
                page.get_by_role("tab", name=tab, exact=True).click()
                if tab == "Objects":
                    page.get_by_label("Arrows", exact=True).locator("visible=true").click()
                # It tells that there is no GPU.
                page.add_style_tag(content=".mantine-Notification-root { display: none }")
                page.mouse.move(200, 400)
                time.sleep(FRAME)
                picture = Image.open(io.BytesIO(page.screenshot(timeout=60_000))).convert("RGB")
                picture.quantize(128, method=Image.Quantize.MEDIANCUT).save(HERE / f"{name}.png", optimize=True)
                page.close()
        browser.close()


def play(session: Any, seconds: float) -> None:
    """Play for a simulated time, and hold."""
    session.play()
    while session.latest().time < seconds:
        time.sleep(0.01)
    session.pause()
    session.settle()


if __name__ == "__main__":
    main()
