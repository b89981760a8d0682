"""Fixtures and the home of the markers ``egl``, ``browser`` and ``cluster``."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import util

import pytest
import warp as wp
from browsers import chromium

from warpjelly.device import start_warp


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test that asks for a device on the CPU and, where there is one, on the first GPU."""
    if "device" in metafunc.fixturenames:
        start_warp()
        metafunc.parametrize("device", ["cpu", "cuda:0"] if wp.is_cuda_available() else ["cpu"])


@pytest.fixture(params=["float32", "float64"])
def precision(request: pytest.FixtureRequest) -> str:
    """Return the floating-point type of the simulation."""
    return request.param


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip marked tests where what they need is missing, unless WARPJELLY_REQUIRE_EGL=1 or the like forbids it."""
    for marker, is_there, reason in (
        ("egl", _has_egl, "offscreen OpenGL does not work here"),
        ("browser", _has_browser, "no Chromium here"),
        ("cluster", _has_ray, "no Ray here"),
    ):
        marked = [item for item in items if item.get_closest_marker(marker)]
        if not marked or os.environ.get(f"WARPJELLY_REQUIRE_{marker.upper()}") == "1" or is_there():
            continue
        for item in marked:
            item.add_marker(pytest.mark.skip(reason=reason))


def _has_browser() -> bool:
    return chromium() is not None and util.find_spec("playwright") is not None


def _has_ray() -> bool:
    return util.find_spec("ray") is not None


def _has_egl() -> bool:
    # In a process of its own: where it does not work, VTK may crash instead of failing.
    script = "from warpjelly.previews.view import require_pyvista; require_pyvista()"
    return subprocess.run([sys.executable, "-c", script], check=False, capture_output=True).returncode == 0
