"""Plots of metrics: what they read, and that they say what is wrong."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from warpjelly.errors import EnvironmentFailedError, InputError
from warpjelly.previews.plots import plot_metrics, read_metrics

COLUMNS = (
    "frame time kinetic elastic potential contact spring_losses field_work contact_losses friction_losses "
    "momentum_x momentum_y momentum_z angular_momentum_x angular_momentum_y angular_momentum_z "
    "max_speed max_penetration max_overlap contacts"
).split()


def write_metrics(folder: Path, frames: int = 5) -> Path:
    """Write metrics of which each column is its number times the time, and return their folder."""
    folder.mkdir(exist_ok=True)
    with open(folder / "metrics.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows([[frame, *(frame / 10 * k for k in range(1, len(COLUMNS)))] for frame in range(frames)])
    return folder


@pytest.mark.parametrize("frames", [1, 5])
def test_metrics_are_read_by_name(tmp_path: Path, frames: int) -> None:
    """Find every column, and the account: all energies and losses less the work of fields."""
    metrics = read_metrics(write_metrics(tmp_path, frames))
    time = np.arange(frames) / 10
    np.testing.assert_allclose(metrics["time"], time)
    np.testing.assert_allclose(metrics["contacts"], COLUMNS.index("contacts") * time)
    np.testing.assert_allclose(metrics["sum"], (2 + 3 + 4 + 5 + 6 - 7 + 8 + 9) * time)


def test_plots_are_a_picture(tmp_path: Path) -> None:
    """Draw curves in several colours on white, of the size asked for; the stage of the run names the run, too."""
    from PIL import Image

    stage = write_metrics(tmp_path / "run") / "stage.usdc"
    stage.touch()
    plot_metrics(stage, tmp_path / "new" / "p.png", size=(900, 500))
    with Image.open(tmp_path / "new" / "p.png") as picture:
        assert (picture.format, picture.size) == ("PNG", (900, 500))
        shown = np.asarray(picture.convert("RGB"))
    assert (shown == 255).all(axis=2).mean() > 0.8
    assert (np.ptp(shown.astype(int), axis=2) > 100).sum() > 1000
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["p.png"]


@pytest.mark.parametrize(
    ("text", "output", "size", "what"),
    [
        (",".join(COLUMNS) + "\n" + "a," * len(COLUMNS), "p.png", (900, 500), "not the metrics of a run"),
        (None, "p.png", (900, 500), r"no metrics\.csv here"),
        ("", "p.png", (900, 500), "not the metrics of a run"),
        ("time,kinetic\n0,1\n", "p.png", (900, 500), "not the metrics of a run"),
        (",".join(COLUMNS) + "\n0,1\n", "p.png", (900, 500), "not the metrics of a run"),
        (",".join(COLUMNS) + "\n", "p.png", (900, 500), "not the metrics of a run"),
        (",".join(COLUMNS), "p.mp4", (900, 500), r"ends in \.png"),
        (",".join(COLUMNS), "p.png", (900, 300), "size 900x300"),
        (",".join(COLUMNS), "there.png", (900, 500), "--force"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_wrong_input_is_explained(
    tmp_path: Path, text: str | None, output: str, size: tuple[int, int], what: str
) -> None:
    """Refuse what cannot be plotted in one line."""
    (tmp_path / "there.png").touch()
    if text is not None:
        (tmp_path / "metrics.csv").write_text(text)
    with pytest.raises(InputError, match=what) as caught:
        plot_metrics(tmp_path, tmp_path / output, size=size)
    assert "\n" not in str(caught.value)


def test_missing_matplotlib_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Name the extra that brings it."""
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(InputError, match=r"pip install 'warpjelly\[preview\]'"):
        plot_metrics(write_metrics(tmp_path), tmp_path / "p.png")


def test_unwritable_plots_are_reported(tmp_path: Path) -> None:
    """Say in one line that the file cannot be written."""
    run = write_metrics(tmp_path)
    with pytest.raises(EnvironmentFailedError, match="cannot write the plots"):
        plot_metrics(run, run / "metrics.csv" / "p.png")
