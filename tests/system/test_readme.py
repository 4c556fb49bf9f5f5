"""The Python example of the README runs as it is printed, with a coarser sensor and fewer images."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# The thesis's sensor with pixels 4 times as large: the same view in a sixteenth of the pixels.
SENSOR = """
base = "thesis"
name = "small"
[camera]
width_px = 320
height_px = 256
pixel_size_um = 21.2
"""
STEP_MM = 6.0
"""Six profiles of both spheres in place of 38; enough for the four parameters of each."""


def test_the_readme_example_runs(tmp_path: Path):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    scene = (ROOT / "scenes" / "spheres.toml").read_text(encoding="utf-8")
    motion = {
        key: float(re.search(rf"^{key} = ([-\d.]+)", scene, re.MULTILINE).group(1)) for key in ("step_mm", "count")
    }
    count = round(motion["step_mm"] * motion["count"] / STEP_MM)
    scene = re.sub(r"^step_mm = .*", f"step_mm = {STEP_MM}", scene, flags=re.MULTILINE)
    scene = re.sub(r"^count = .*", f"count = {count}", scene, flags=re.MULTILINE)
    (tmp_path / "small.toml").write_text(SENSOR, encoding="utf-8")
    (tmp_path / "scene.toml").write_text(scene, encoding="utf-8")
    reduced = example.replace('"spheres"', '"scene.toml"').replace('"thesis"', '"small.toml"')
    assert reduced.count("small.toml") == 2 and reduced.count("scene.toml") == 1
    done = subprocess.run([sys.executable, "-c", reduced], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # The spheres are found; how well so few profiles measure their spacing is not what is tested.
    assert abs(float(done.stdout)) < 1.0
    assert (tmp_path / "spheres.png").stat().st_size > 0
