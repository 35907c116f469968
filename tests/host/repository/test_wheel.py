"""The wheel, installed as a user has it: away from the checkout, with nothing beside it."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

from jaxslam.sensors.camera import known_cameras

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new environment with the wheel in it, which borrows the dependencies of this one instead of fetching them.

    A path that a `.pth` file adds comes after the environment's own packages, and `.pth` files in the folder it names
    are not read: the checkout, installed editable here, is out of sight.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    scheme = {"base": str(folder), "platbase": str(folder)}
    packages = Path(sysconfig.get_path("purelib", vars=scheme))
    (packages / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    install = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "install", "--no-deps"]
    subprocess.run([*install, "--ignore-installed", str(wheel)], check=True, capture_output=True)
    return folder


def _run(arguments: list[str | Path], folder: str | Path) -> str:
    variables = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        list(map(str, arguments)), cwd=folder, env=variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_wheel_holds_what_is_needed_and_no_more(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0].partition("-")[0] for name in names} == {"jaxslam", "jaxslam_kernels"}
    assert {"jaxslam/py.typed", "jaxslam_kernels/py.typed"} <= set(names)
    assert {f"jaxslam/_configs/cameras/{camera}.yaml" for camera in known_cameras()} <= set(names)
    assert "jaxslam/_configs/presets/default.yaml" in names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_imports_from_anywhere(environment: Path) -> None:
    code = (
        "import json, jaxslam, jaxslam_kernels, jaxslam.config.loading, jaxslam.sensors.camera\n"
        "places = [jaxslam.__file__, jaxslam_kernels.__file__, str(jaxslam.config.loading.configs_dir())]\n"
        "print(json.dumps([places, jaxslam.sensors.camera.known_cameras()]))"
    )
    places, cameras = json.loads(_run([environment / "bin" / "python", "-W", "error", "-c", code], "/"))
    assert all(Path(place).is_relative_to(environment) for place in places), places
    assert cameras == known_cameras()


def test_is_a_module_too(environment: Path) -> None:
    python, command = environment / "bin" / "python", environment / "bin" / "jaxslam"
    assert _run([python, "-m", "jaxslam", "models", "list"], "/") == _run([command, "models", "list"], "/")


@pytest.mark.slow
def test_demo_runs_in_another_folder(environment: Path, tmp_path: Path) -> None:
    printed = _run([environment / "bin" / "jaxslam", "demo", "--frames", "12", "--out", tmp_path / "out"], tmp_path)
    assert "12 of 12" in printed
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["frames"] == 12
    assert summary["commit"] is None  # an installed package knows no commit: this is not the checkout
