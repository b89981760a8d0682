"""The page of a batch: what batch.json says, to sort, filter, plot and look at in a browser, without anything else."""

from __future__ import annotations

import base64
import io
import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import opened
from PIL import Image
from runs import CUBE
from shots import make_shot, shot_scene
from stages import cube_surface, make_scene, write_stage

from warpjelly.batch import report, sheet
from warpjelly.batch.batch import RunsFailedError, run_batch
from warpjelly.batch.sheet import compared, present
from warpjelly.batch.sweep import Sweep
from warpjelly.errors import EnvironmentFailedError, InputError
from warpjelly.previews import thumbnails
from warpjelly.previews.thumbnails import SIZE, draw_thumbnails
from warpjelly.run import simulate
from warpjelly.scene import Expect
from warpjelly.stage.stagefiles import open_stage
from warpjelly.stage.validate import stage_problems

# All that may end the script that a page has it in, or be taken for a place of its template.
REASON = "the simulation <!--<script> </script> {{PICTURES}} diverged"
STIFFNESSES, DAMPINGS = [50, 100, 1000], [0.1, 0.5]


def bounce(stiffness: float, damping: float) -> float:
    """Return a figure that differs from run to run."""
    return stiffness**0.5 - 10 * damping


def a_run(name: str, **told: Any) -> dict[str, Any]:
    """Return an entry of batch.json."""
    nothing = {"reason": None, "parameters": {}, "figures": {}, "stage": None, "log": None, "expect": []}
    return {"name": name, "source": "sweep.toml", "status": "finished", **nothing, **told}


def a_record() -> dict[str, Any]:
    """Return the record of a batch of six runs that are finished, one that failed and one that was not begun."""
    runs = []
    for k in STIFFNESSES:
        for d in DAMPINGS:
            figures = {"bounce": bounce(k, d), "frames": 10, "wall_seconds": 0.5}
            missed = {"quantity": "bounce", "body": "cube", "value": bounce(k, d), "min": 5.0, "max": None}
            expect = [{**missed, "met": bounce(k, d) >= 5.0}]
            given = {"stiffness": k, "damping": d}
            runs.append(a_run(f"k{k}_d{d}", parameters=given, figures=figures, expect=expect))
    broken = {"parameters": {"stiffness": 1e9, "damping": 0.1}, "status": "failed", "log": "broken/run.log"}
    runs.append(a_run("broken", reason=REASON, figures={"bounce": 1e9}, **broken))
    runs.append(a_run("waiting", parameters={"stiffness": 7, "damping": 0.1}, status="unfinished"))
    counts = {"runs": 8, "finished": 6, "failed": 1, "unfinished": 1}
    began = "2026-01-02T03:04:05+00:00"
    return {"warpjelly": "0", "workers": 2, "began": began, "wall_seconds": 3.0, "counts": counts, "runs": runs}


def contents(page: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what a page has: its description and its pictures."""
    scripts = re.findall(r'<script type="application/json" id=".*?">(.*?)</script>', page.read_text(), re.DOTALL)
    described, pictures = map(json.loads, scripts)
    return described, pictures


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Iterator[tuple[Any, list[str]]]:
    """Open the page of that batch, without pictures."""
    folder = tmp_path_factory.mktemp("pages") / "my & batch"
    folder.mkdir()
    present(folder, a_record(), pictures=False)
    with opened(folder / "index.html") as (shown, complaints):
        yield shown, complaints
        assert complaints == []


def rows(page: Any) -> list[list[str]]:
    """Return the texts of the rows of the table that are shown."""
    found = page.eval_on_selector_all(
        "#rows tr", "all => all.filter(row => !row.hidden).map(row => [...row.cells].map(cell => cell.textContent))"
    )
    return [list(row) for row in found]


def names(page: Any) -> list[str]:
    """Return the names of the runs that the table shows, in order."""
    return [row[0] for row in rows(page)]


@pytest.mark.browser
def test_page_tells_of_every_run(page) -> None:
    """Find counts, parameters and figures in the table, the reason of the one that failed on its card, and links."""
    shown, _ = page
    assert shown.inner_text("h1") == "my & batch"
    assert [text in shown.inner_text("#counts") for text in ("6 finished", "1 failed", "1 unfinished")] == [True] * 3
    heads = shown.eval_on_selector_all("#heads th", "all => all.map(head => head.textContent)")
    # What is the same in all finished runs is no column.
    assert heads == ["name", "status", "stiffness", "damping", "bounce", "missed", "files", "reason"]
    assert "frames 10" in shown.inner_text("#constant")
    assert rows(shown)[1][:6] == ["k50_d0.5", "✓ finished", "50", "0.5", "2.071", "1"]
    assert rows(shown)[6][2:] == ["1e9", "0.1", "1e9", "", "log ", REASON]
    assert shown.get_attribute("#rows a", "href") == "broken/run.log"
    card = shown.locator(".card", has_text="broken")
    assert "diverged" in card.text_content()
    assert "missed 1 of 1" in shown.locator(".card", has_text="k50_d0.5").text_content()
    assert "were not drawn" in shown.inner_text("#missing")


@pytest.mark.browser
def test_headers_sort(page) -> None:
    """Sort by numbers up, down and not at all, with keys as well; runs without the number come last."""
    shown, _ = page
    original = names(shown)
    button = shown.locator("#heads button", has_text="bounce")
    button.click()
    finished = sorted((bounce(k, d), f"k{k}_d{d}") for k in STIFFNESSES for d in DAMPINGS)
    ascending = [name for _, name in finished]
    assert names(shown) == [*ascending, "broken", "waiting"]
    assert shown.get_attribute("#heads th:nth-child(5)", "aria-sort") == "ascending"
    cards = shown.eval_on_selector_all(".card b", "all => all.map(name => name.textContent)")
    assert cards[: len(ascending)] == ascending
    assert shown.input_value("#chosen") == f"warpjelly compare {' '.join(ascending)} -o chosen.usda"
    button.press("Enter")
    assert names(shown) == ["broken", *ascending[::-1], "waiting"]
    button.press("Enter")
    assert names(shown) == original


@pytest.mark.browser
@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stiffness>200", ["k1000_d0.1", "k1000_d0.5", "broken"]),
        ("stiffness > 200 status=finished", ["k1000_d0.1", "k1000_d0.5"]),
        ("stiff<=100 damp!=0.1", ["k50_d0.5", "k100_d0.5"]),
        ("bounce>=5 bounce<20", ["k50_d0.1", "k100_d0.1", "k100_d0.5"]),
        ("DIVERGED", ["broken"]),
        ('"stiffness 50"', ["k50_d0.1", "k50_d0.5"]),
        ("missed=1", ["k50_d0.5"]),
        ("nothing like that", []),
    ],
)
def test_filter_takes_words_and_conditions(page, text, expected) -> None:
    """Show in table, cards and plot what fits all words and conditions."""
    shown, _ = page
    shown.fill("#filter", text)
    assert names(shown) == expected
    assert shown.locator(".card:visible").count() == len(expected)
    assert shown.inner_text("#shown") == f"{len(expected)} of 8 shown"
    finished = [name for name in expected if name.startswith("k")]
    assert shown.locator("#graph circle").count() == len(finished)
    # There are no axes without values.
    assert (shown.locator("#graph .grid").count() > 0) == bool(finished)
    command = f"warpjelly compare {' '.join(finished)} -o chosen.usda" if len(finished) > 1 else ""
    assert shown.input_value("#chosen") == command
    shown.fill("#filter", "")


@pytest.mark.browser
@pytest.mark.parametrize(
    ("text", "message"),
    [("mass>3", 'nothing is called "mass"'), ("stiffness>", "stiffness > what?"), ("stiffness>soft", "give a number")],
)
def test_filter_says_what_is_wrong(page, text, message) -> None:
    """Say so and leave what is shown."""
    shown, _ = page
    shown.fill("#filter", text)
    assert message in shown.inner_text("#wrong")
    assert len(rows(shown)) == 8
    shown.fill("#filter", "")
    assert shown.inner_text("#wrong") == ""


@pytest.mark.browser
def test_plot_shows_a_figure_against_a_parameter(page) -> None:
    """Choose axes; the points of finished runs are where their values say, and a hovered point tells its run."""
    shown, _ = page
    shown.select_option("#y", label="bounce")
    shown.select_option("#x", label="damping")
    shown.select_option("#color", label="stiffness")
    places = "all => all.map(at => [at.cx.baseVal.value, at.cy.baseVal.value])"
    points = np.array(shown.eval_on_selector_all("circle", places))
    values = np.array([[d, bounce(k, d)] for k in STIFFNESSES for d in DAMPINGS])
    for at, value in zip(points.T, values.T, strict=True):
        slope, start = np.polyfit(value, at, 1)
        # Places are float32 in SVG.
        np.testing.assert_allclose(slope * value + start, at, atol=1e-3)
    assert (points[:, 1] > 0).all()
    assert np.polyfit(values[:, 1], points[:, 1], 1)[0] < 0
    texts = shown.eval_on_selector_all("#graph text", "all => all.map(text => text.textContent)")
    assert "bounce: greatest rise of the centre of mass after its first low, m" in texts
    assert len(set(shown.eval_on_selector_all("circle", "all => all.map(at => at.getAttribute('fill'))"))) == 3
    # Runs that differ in damping alone are joined.
    assert shown.locator("#graph polyline").count() == 3
    shown.check("#log-y")
    logged = np.array(shown.eval_on_selector_all("circle", places))[:, 1]
    slope, start = np.polyfit(np.log(values[:, 1]), logged, 1)
    np.testing.assert_allclose(slope * np.log(values[:, 1]) + start, logged, atol=1e-3)
    shown.uncheck("#log-y")
    shown.locator("circle").nth(5).hover()
    assert shown.inner_text("#tip").split("\n") == ["k1000_d0.5", "bounce 26.62", "damping 0.5", "stiffness 1000"]
    shown.locator("circle").nth(5).click()
    assert shown.inner_text("tr.marked td") == "k1000_d0.5"
    assert shown.text_content(".card.marked b") == "k1000_d0.5"
    shown.keyboard.press("Escape")
    assert shown.locator(".marked").count() == 0


@pytest.mark.browser
def test_page_fits_small_windows(page) -> None:
    """Have nothing stick out of a window of 400 pixels."""
    shown, _ = page
    shown.set_viewport_size({"width": 400, "height": 700})
    assert shown.evaluate("document.documentElement.scrollWidth") == 400
    shown.set_viewport_size({"width": 1200, "height": 900})


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> tuple[Path, dict[str, Any]]:
    """Return the folder and the record of a batch with stages: one like another, one twice as large, one broken."""
    folder = tmp_path_factory.mktemp("drawn")
    runs = []
    for name, center, frames in (("low", 0.5, 10), ("same", 0.5, 10), ("high", 3.0, 19)):
        (folder / name).mkdir()
        mesh = cube_surface(center=(0.0, center, 0.0))
        write_stage(folder / name / "stage.usdc", make_scene(), frames=frames, meshes=[mesh])
        runs.append(a_run(name, stage=f"{name}/stage.usdc"))
    (folder / "damaged.usdc").write_bytes(b"PXR-USDC and nothing else")
    runs.append(a_run("damaged", stage="damaged.usdc"))
    runs.append(a_run("alone", stage="low/stage.usdc", source="other.toml"))
    return folder, {**a_record(), "runs": runs, "counts": {"runs": 5, "finished": 5, "failed": 0, "unfinished": 0}}


def pictures_of(strip: bytes) -> np.ndarray:
    """Return the pictures of a strip [count, height, width, 3]."""
    with Image.open(io.BytesIO(strip)) as whole:
        pixels = np.asarray(whole.convert("RGB"), int)
    return np.stack(np.split(pixels, pixels.shape[1] // SIZE[0], axis=1))


def jelly(picture: np.ndarray) -> int:
    """Return how many pixels are red or yellow rather than grey."""
    return int((np.ptp(picture, axis=-1) > 60).sum())


@pytest.mark.egl
@pytest.mark.browser
def test_pictures_are_made_to_be_compared(drawn, page) -> None:
    """Draw runs of one sweep from one place at the same times; what cannot be drawn says why, on the page, too."""
    folder, record = drawn
    done: list[tuple[int, int]] = []
    present(folder, record, pictures=True, progress=lambda count, total: done.append((count, total)))
    assert done == [(i, 5) for i in range(1, 6)]
    described, pictures = contents(folder / "index.html")
    assert set(pictures) == {"low", "same", "high", "alone"}
    strips = {name: pictures_of(base64.b64decode(picture)) for name, picture in pictures.items()}
    # The longest run ends after 18 of 24 frames a second; the hardest impact is at the end of this motion.
    np.testing.assert_allclose(described["times"], np.linspace(0, 18 / 24, 8))
    assert [run["impact"] for run in described["runs"]] == [9 / 24, 9 / 24, 18 / 24, None, 9 / 24]
    np.testing.assert_array_equal(strips["low"], strips["same"])
    # Shorter runs show their end then.
    np.testing.assert_allclose(strips["low"][-1], strips["low"][0], atol=40)
    # By itself the cube fills more of the picture than where there is to be place for one that is high up.
    assert jelly(strips["alone"][1]) > 2 * jelly(strips["low"][1]) > 200
    assert jelly(strips["high"][1]) > 100
    assert described["runs"][3]["problem"].startswith(f"{folder / 'damaged.usdc'}: not a readable USD file")
    assert stage_problems(folder / "low") == []
    shown = page[0].context.browser.new_page()
    shown.on("pageerror", lambda error: page[1].append(str(error)))
    shown.goto((folder / "index.html").as_uri())
    assert shown.locator(".picture[role=img]").count() == 4
    assert "not a readable USD file" in shown.locator(".card", has_text="damaged").text_content()
    style = "span => getComputedStyle(span).backgroundPositionX"
    assert shown.eval_on_selector(".picture", style) == "0%"
    shown.locator("#time").press("End")
    assert shown.inner_text("#now") == "0.75 s"
    assert shown.eval_on_selector(".picture", style) == "100%"
    shown.click("#impact")
    assert shown.eval_on_selector(".picture", style) == "0%"
    shown.click("#play")
    shown.wait_for_function("document.getElementById('now').textContent === '0.21 s'")
    shown.close()


@pytest.mark.egl
def test_many_runs_have_fewer_pictures_each(drawn, monkeypatch) -> None:
    """Keep the page of any batch small."""
    folder, _ = drawn
    monkeypatch.setattr(thumbnails, "_MOST_IN_ALL", 6)
    found = draw_thumbnails([{name: folder / name for name in ("low", "high")}])
    assert len(found.times) == 3
    assert {len(pictures_of(strip.image)) for strip in found.strips.values()} == {4}
    monkeypatch.setattr(thumbnails, "_MOST_IN_ALL", 1)
    found = draw_thumbnails([{"low": folder / "low"}])
    assert (found.times, len(pictures_of(found.strips["low"].image))) == ([], 1)


@pytest.mark.egl
def test_runs_over_a_shot_are_drawn_from_their_start_and_are_not_compared(drawn, tmp_path, caplog) -> None:
    """Draw a run over a shot that starts at time code 1001, beside two others, which are compared without it."""
    folder, record = drawn
    scene = shot_scene(make_shot(tmp_path / "shot.usda"), frames=5)
    simulate(scene, output=folder / "over", device="cpu")
    runs = [*record["runs"][:2], a_run("over", stage="over/stage.usda", source="shot.toml")]
    present(folder, {**record, "runs": runs}, pictures=True)
    described, pictures = contents(folder / "index.html")
    assert described["runs"][2]["problem"] is None
    # The shot goes on until time code 1015, at 25 a second; without colours its end stands for the hardest impact.
    assert described["times"][-1] == pytest.approx(14 / 25)
    assert described["runs"][2]["impact"] == pytest.approx(14 / 25)
    strip = pictures_of(base64.b64decode(pictures["over"]))
    # It falls from the start on.
    assert (strip[1] != strip[2]).any()
    stage = open_stage(folder / "comparison.usda")
    assert [prim.GetName() for prim in stage.GetPrimAtPath("/World/runs").GetChildren()] == ["low", "same"]
    assert f"not in {folder / 'comparison.usda'}: {folder / 'over/stage.usda'}: has no bodies below" in caplog.text


@pytest.mark.egl
def test_ctrl_c_ends_drawing_between_two_runs(drawn) -> None:
    """Draw the run that is begun to its end: what is interrupted inside VTK can crash."""
    folder, _ = drawn
    done: list[int] = []

    def interrupt(count: int, total: int) -> None:
        done.append(count)
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            draw_thumbnails([{name: folder / name for name in ("low", "high")}], interrupt)
    finally:
        signal.signal(signal.SIGINT, before)
    assert done == [1]


@pytest.mark.parametrize(
    "error",
    [
        InputError("previews need pyvista: pip install 'warpjelly[preview]'"),
        EnvironmentFailedError("no offscreen OpenGL: apt install libegl1 libgl1-mesa-dri"),
    ],
)
def test_page_is_made_without_what_draws(drawn, monkeypatch, caplog, error) -> None:
    """Make the page all the same; it says how to get pictures, and so does one warning."""

    def fail(size: tuple[int, int]) -> None:
        raise error

    folder, record = drawn
    monkeypatch.setattr(thumbnails, "View", fail)
    present(folder, record, pictures=True)
    described, pictures = contents(folder / "index.html")
    assert pictures == {}
    assert described["missing"] == f"No pictures: {error}; then warpjelly batch --resume draws them."
    damage, said = [line.getMessage() for line in caplog.records if line.levelname == "WARNING"]
    assert said == f"{folder / 'index.html'} has no pictures: {error}"
    # One of the runs is damaged.
    assert damage.startswith(f"not in {folder / 'comparison.usda'}: {folder / 'damaged.usdc'}: not a readable USD ")
    assert len(open_stage(folder / "comparison.usda").GetPrimAtPath("/World/runs").GetChildren()) == 4


def test_a_batch_leaves_page_and_comparison(tmp_path) -> None:
    """Run a sweep of three: both are there, also after --resume with nothing to do, and after all but one have gone."""
    keys = ["materials.jelly.structural.stiffness"]
    sweep = Sweep(
        base=CUBE,
        name="k{k}",
        vary={"k": {"keys": keys, "values": [50, 100, 1e9]}},
        set={"bodies.cube.particles_per_edge": 3, "duration": 0.1},
    )
    out = tmp_path / "out"
    for resume in (False, True):
        with pytest.raises(RunsFailedError, match="1 of 3 runs failed"):
            run_batch(sweep, output=out, device="cpu", workers=1, resume=resume)
        described, _ = contents(out / "index.html")
        assert [run["status"] for run in described["runs"]] == ["finished", "finished", "failed"]
        assert described["links"] == ["batch.csv", "comparison.usda"]
        assert stage_problems(out / "comparison.usda") == []
        stage = open_stage(out / "comparison.usda")
        assert [prim.GetName() for prim in stage.GetPrimAtPath("/World/runs").GetChildren()] == ["k50", "k100"]
        (out / "index.html").unlink()
    given = [out, out / "k50", out / "k100" / "stage.usdc"]
    assert [run.name for run in compared(given)] == ["k50", "k100", "k50", "stage"]
    only = sweep.model_copy(update={"vary": {"k": sweep.vary["k"].model_copy(update={"values": [50]})}})
    run_batch(only, output=out, device="cpu", workers=1, resume=True)
    assert not (out / "comparison.usda").exists()


def test_every_figure_has_a_meaning() -> None:
    """Say of every figure that batch.json may have what it is, in which unit."""
    of_runs = {*report._OF_RECORD, *report._GREATEST, *report._LAST}
    assert of_runs == set(sheet._MEANINGS)
    assert not of_runs & set(Expect.model_fields)
