import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SOURCE_FOLDERS = ("warpjelly", "kernels", "tests", "scenes", "benchmarks")


def run(arguments: list[object], *, cwd: Path, **environment: str) -> str:
    """Run a command that has to succeed and return its stdout."""
    result = subprocess.run(
        [str(argument) for argument in arguments],
        cwd=cwd,
        env=os.environ | environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, f"{arguments}\n{result.stdout}\n{result.stderr}"
    return result.stdout


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel and install it alone into a folder of its own."""
    source, wheels, target = (tmp_path_factory.mktemp(name) for name in ("source", "wheels", "site"))
    # A copy, because setuptools leaves build/ and *.egg-info beside what it builds.
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("warpjelly", "kernels"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    run([*pip, "wheel", source, "--no-deps", "--no-build-isolation", "-w", wheels], cwd=wheels)
    (wheel,) = wheels.glob("*.whl")
    run([*pip, "install", "--no-deps", "--target", target, wheel], cwd=wheels)
    return target


def test_declared_packages_are_the_folders_on_disk() -> None:
    """Declare every folder of Python files below `warpjelly` and `kernels`, and no other."""
    found = {path.parent.relative_to(ROOT) for name in ("warpjelly", "kernels") for path in (ROOT / name).rglob("*.py")}
    declared = PYPROJECT["tool"]["setuptools"]
    assert {Path(folder) for folder in declared["package-dir"].values()} == found
    assert sorted(declared["packages"]) == sorted(declared["package-dir"])
    assert all((ROOT / folder / "__init__.py").is_file() for folder in found)


def test_kernels_have_one_import_name() -> None:
    """Import the kernels as `warpjelly.kernels` everywhere."""
    pattern = re.compile(r"^\s*(import|from)\s+kernels\b", re.MULTILINE)
    sources = [path for name in SOURCE_FOLDERS for path in (ROOT / name).rglob("*.py")]
    assert sources
    assert [path for path in sources if pattern.search(path.read_text(encoding="utf-8"))] == []


def test_licence_field_and_file_agree() -> None:
    """Ship the text of the licence that the metadata name."""
    project = PYPROJECT["project"]
    assert project["license"] == "Apache-2.0"
    (name,) = project["license-files"]
    text = (ROOT / name).read_text(encoding="utf-8")
    assert text.split()[:4] == ["Apache", "License", "Version", "2.0,"]
    assert "END OF TERMS AND CONDITIONS" in text


def test_wheel_holds_the_packages(site: Path) -> None:
    """Install both packages, their data and the licence, and nothing at the top level besides."""
    folders = {path.name for path in site.iterdir()}
    assert folders == {"warpjelly", "bin", f"warpjelly-{PYPROJECT['project']['version']}.dist-info"}
    assert all((site / "warpjelly" / name).is_file() for name in ("py.typed", "baseline.json", "previews/review.html"))
    assert list(site.glob("*.dist-info/licenses/LICENSE"))
    for package, folder in (("warpjelly", "warpjelly"), ("warpjelly/kernels", "kernels")):
        installed = {path.name for path in (site / package).glob("*.py")}
        assert installed == {path.name for path in (ROOT / folder).glob("*.py")}


def test_wheel_imports_its_own_kernels(site: Path, tmp_path: Path) -> None:
    """Find the kernels of the wheel from another folder, not those of the clone."""
    script = "import warpjelly.kernels; print(warpjelly.kernels.__file__)"
    output = run([sys.executable, "-P", "-c", script], cwd=tmp_path, PYTHONPATH=str(site))
    assert Path(output.strip()) == site / "warpjelly" / "kernels" / "__init__.py"


@pytest.mark.parametrize("scene", ["jello_cube"])
def test_wheel_runs_a_scene(site: Path, tmp_path: Path, scene: str) -> None:
    """Simulate a scene with the installed command from another folder."""
    # The console script, with -P so that its own folder does not come first on the path.
    command = [sys.executable, "-P", site / "bin" / "warpjelly", "run", ROOT / "scenes" / f"{scene}.toml"]
    options = ["--frames", 2, "-o", tmp_path / "out", "--json"]
    output = run([*command, *options], cwd=tmp_path, PYTHONPATH=str(site))
    assert json.loads(output)["frames"] == 2
    assert (tmp_path / "out" / "stage.usdc").is_file()
