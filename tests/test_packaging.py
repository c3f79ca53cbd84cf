"""What is installed: pins that fit the ranges on every Python, declared imports, a wheel with the right content."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
# import name -> distribution, where they differ
DISTRIBUTION = {
    "PIL": "pillow",
    "collada": "pycollada",
    "cv2": "opencv-python-headless",
    "sklearn": "scikit-learn",
    "yaml": "pyyaml",
    "libusb_package": "libusb-package",
}


def project() -> dict:
    tomllib = pytest.importorskip("tomllib" if sys.version_info >= (3, 11) else "tomli")  # pytest brings tomli along
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def pins(python: str, text: str | None = None) -> dict[str, Requirement]:
    """The constraints that hold on a Python, by name; fails when a name has none or two versions there."""
    found: dict[str, Requirement] = {}
    for line in (text or (ROOT / "constraints.txt").read_text()).splitlines():
        if line.strip() and not line.startswith("#"):
            pin = Requirement(line)
            if pin.marker is None or pin.marker.evaluate({"python_version": python}):
                assert pin.name not in found, f"{pin.name} is pinned twice on {python}"
                found[canonicalize_name(pin.name)] = pin
    return found


@pytest.mark.parametrize("python", PYTHONS)
def test_every_dependency_is_pinned_within_its_range(python: str) -> None:
    pinned, declared = pins(python), project()
    for text in [*declared["dependencies"], *declared["optional-dependencies"]["test"]]:
        wanted = Requirement(text)
        if wanted.marker and not wanted.marker.evaluate({"python_version": python}):
            continue
        (exact,) = pinned[canonicalize_name(wanted.name)].specifier
        assert exact.operator == "==" and wanted.specifier.contains(exact.version), f"{wanted} has {exact}"


def test_torch_is_pinned_and_numpy_differs_on_python_3_10() -> None:
    assert {str(pins(python)["torch"].specifier) for python in PYTHONS} == {"==2.13.0"}
    assert str(pins("3.10")["numpy"].specifier) != str(pins("3.11")["numpy"].specifier)


def test_two_pins_for_one_python_are_noticed() -> None:
    with pytest.raises(AssertionError, match="twice on 3.11"):
        pins("3.11", 'numpy==1 ; python_version < "3.12"\nnumpy==2 ; python_version >= "3.11"')


def imported(path: Path) -> set[str]:
    """Top-level names of the modules a file imports, wherever the import stands."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return names


def test_what_is_imported_is_declared_and_nothing_more() -> None:
    def names(texts: list[str]) -> set[str]:
        return {canonicalize_name(Requirement(text).name) for text in texts}

    declared = names(project()["dependencies"])
    extras = project()["optional-dependencies"]
    optional = names(
        [
            text
            for extra in ("cluster", "e57", "exr", "gsplat", "meshopt", "parquet", "recordings", "splats", "zero123")
            for text in extras[extra]
        ]
    )
    optional |= {"dask", "huggingface-hub", "llvmlite"}  # come with distributed, diffusers and numba
    used = set().union(*(imported(path) for path in (ROOT / "dpcli").rglob("*.py")))
    foreign = {name for name in used - {"dpcli", "tomllib"} if name not in sys.stdlib_module_names}
    found = {canonicalize_name(DISTRIBUTION.get(name, name)) for name in foreign}
    assert found - optional == declared and found <= declared | optional


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel of a copy of the sources, so that the checkout stays clean."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "dpcli", source / "dpcli", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "tests", source / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "LICENSE"):
        shutil.copy(ROOT / name, source)
    (source / "README.md").write_text("a readme")
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-q", "-w", folder, source]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return zipfile.ZipFile(next(folder.glob("*.whl")))


def test_the_wheel_holds_the_package_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    names = wheel.namelist()
    kinds = (".py", ".js", ".html", ".css")  # modules, and what pages are made of
    sources = {str(path.relative_to(ROOT)) for path in (ROOT / "dpcli").rglob("*.*") if path.suffix in kinds}
    assert sources <= set(names)
    assert {name.split("/")[0].split("-")[0] for name in names} == {"dpcli", "dpc_toolkit"}
    assert any(name.endswith("licenses/LICENSE") for name in names)
    entry = next(name for name in names if name.endswith("entry_points.txt"))
    assert "dpc = dpcli.__main__:main" in wheel.read(entry).decode()


def test_the_wheel_has_the_version_of_the_code(wheel: zipfile.ZipFile) -> None:
    from dpcli import __version__

    metadata = wheel.read(next(name for name in wheel.namelist() if name.endswith("METADATA"))).decode()
    assert f"\nVersion: {__version__}\n" in metadata
    assert "\nRequires-Python: <3.14,>=3.10\n" in metadata


def test_ci_runs_the_tests() -> None:
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK) and "make test" in script.read_text()


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_says_what_it_would_do() -> None:
    def dry(*arguments: str) -> str:
        result = subprocess.run(["make", "-n", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
        return result.stdout

    synthetic, real = dry("demo"), dry("demo", "MSRACTION=/some where")
    assert "prepare synthetic gestures" in synthetic and "msraction3d" not in synthetic
    assert 'prepare msraction3d "/some where"' in real
    for step in ("classify train", "classify predict", "evaluate classification", "-c constraints.txt"):
        assert step in dry("-W", "pyproject.toml", "demo")
    assert "pytest" in dry("test")
