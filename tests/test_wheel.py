"""The wheel holds all that the program reads at run time, so that an installation without the checkout works."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the project's wheel and unpack it."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--wheel-dir", str(folder), str(ROOT)], check=True)
    (built,) = folder.glob("*.whl")
    with zipfile.ZipFile(built) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


def test_the_wheel_holds_every_file_of_the_packages_and_scenes(wheel: Path):
    sources = [path.relative_to(ROOT) for name in ("uwlts", "twin", "scenes") for path in (ROOT / name).rglob("*.*")]
    files = [path for path in sources if "__pycache__" not in path.parts]
    assert len(files) > 300
    placed = [Path("uwlts", path) if path.parts[0] == "scenes" else path for path in files]
    assert [str(path) for path in placed if not (wheel / path).is_file()] == []


def test_a_scene_is_rendered_from_the_wheel(wheel: Path, tmp_path: Path):
    """In another folder, with nothing of the checkout on the path."""
    environment = {**os.environ, "PYTHONPATH": str(wheel)}

    def run(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    places = run("-c", "import twin, uwlts; print(twin.__file__); print(uwlts.__file__)").split()
    assert all(Path(place).is_relative_to(wheel) for place in places), places
    run("-m", "twin", "simulate", "step", "--spp", "1", "--out", "step.h5")
    assert (tmp_path / "step.h5").is_file()
