"""Automatic exposure of real runs of ``uwlts scan`` at a served twin, against the exposures that the twin chooses."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from twin.devices.serve import ServedTwin, serve
from twin.scene.description import Scene, load_scene
from uwlts.storage.capture import Capture
from uwlts.stripe import find_stripes

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
SENSOR = """
base = "thesis"
name = "coarse"
[camera]
width_px = 640
height_px = 512
pixel_size_um = 10.6
[stage]
travel_mm = 400.0
resolution_mm = 0.01
settling_s = 0.0
"""
# A board, and a bar 60 mm nearer between the positions of the automatic exposure.
BAR = """
title = "Board and bar"
medium = "air"
[motion]
start_mm = -20.0
step_mm = 2.0
count = 21
[[objects]]
kind = "plate"
width_mm = 200.0
height_mm = 160.0
reflectance = 0.1
[[objects]]
kind = "plate"
width_mm = 5.0
height_mm = 160.0
position_mm = [5.0, 0.0, -20.0]
reflectance = 0.8
"""
DESCRIPTIONS = {"sensor": SENSOR, "bar": BAR}


def scanned(scene: Scene, served: ServedTwin, folder: Path, out: Path) -> str:
    """Scan the scene's motion with automatic exposure; what the command said on standard error."""
    motion, plan = scene.motion, folder / "plan.toml"
    plan.write_text(
        f'title = "Scan"\nsensor = "sensor.toml"\nmedium = "{scene.medium}"\ncamera = "{served.camera.address}"\n'
        f"lights = {list(motion.lights)}\nbracket = {list(motion.bracket)}\n"
        f'[stage]\nport = "{served.controller.port}"\n'
        f"start_mm = {served.track.start_mm}\nstep_mm = {motion.step_mm}\ncount = {motion.count}\n"
        f"direction = {list(map(float, motion.unit_direction()))}\nfeed_mm_per_min = 900.0\n",
        encoding="utf-8",
    )
    done = subprocess.run(
        [sys.executable, "-m", "uwlts", "scan", str(plan), "--out", str(out), "--home"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.parametrize(
    ("name", "placement"), [("plane", "near-turned"), ("spheres", "near"), ("step-scan", "near"), ("target", None)]
)
def test_it_agrees_with_the_twin(folder, sensor, tmp_path, name, placement):
    """At the same three positions: the first, the middle and the last."""
    scene = load_scene(name, placement=placement)
    motion = scene.motion
    way = (motion.count - 1) * motion.step_mm
    scene = scene.model_copy(update={"motion": motion.model_copy(update={"count": 3, "step_mm": way / 2})})
    with serve(scene, sensor=sensor, spp=16, speed_up=50.0) as served:
        # A sphere that just touches the sheet, at the last position, is faint, as a warning states.
        assert "saturated" not in scanned(scene, served, folder, tmp_path / "scan.h5")
        expected = served.exposure_ms
    with Capture(tmp_path / "scan.h5") as scan:
        for laser_on, light in ((True, "laser"), (False, "lamp")):
            used = set(scan.exposure_ms[scan.laser_on == laser_on].round(4).tolist())
            # One exposure for each light. Both bring all but 2 % of the lit lines to 80 % of full scale. Here the
            # maximum of several pixels with shot noise counts at each peak; accuracy 10 %.
            assert len(used) == (light in scene.motion.lights)
            for exposure_ms in used:
                assert exposure_ms == pytest.approx(expected[light], rel=0.25)
        saturated = [(scan.image(k).max(axis=0) >= 255).mean() for k in range(len(scan))]
        # 2 % of the lines may be brighter than 80 %, so no more saturate.
        assert max(saturated) < 0.02


def test_what_comes_nearer_later_is_taken_again_with_a_shorter_exposure(folder, sensor, tmp_path):
    scene = load_scene(folder / "bar.toml")
    with serve(scene, sensor=sensor, spp=4, speed_up=50.0) as served:
        said = scanned(scene, served, folder, tmp_path / "scan.h5")
    with Capture(tmp_path / "scan.h5") as scan:
        exposures = scan.exposure_ms
        saturated = np.array([(scan.image(k).max(axis=0) >= 255).mean() for k in range(len(scan))])
    nearer = int(np.flatnonzero(np.diff(exposures))[0]) + 1
    # The bar reaches over the positions 2.5 to 7.5 mm of the scene, from the twelfth on.
    assert nearer == 12
    # Eight times the reflectance, and 20 of some 400 mm nearer to laser and camera.
    assert exposures[0] / exposures[-1] == pytest.approx(8 * (400 / 380) ** 2, rel=0.25)
    assert set(exposures[:12]) == {exposures[0]} and set(exposures[12:]) == {exposures[-1]}
    assert (saturated < 0.05).all()
    # The dim board behind the bar is faint from there on, which is said at the end.
    assert said.count("saturated on many lines: exposed by") == said.count("from here on") == 1
    # A machine that has other work may lose images on their way, which are taken again and mentioned.
    assert (
        said.count("warning:") - said.count("lost between camera and computer") == 2
        and "laser images are faint" in said
    )


def test_a_bracket_multiplies_the_exposure_that_was_found(folder, sensor, tmp_path):
    """Long exposures of a bright board are saturated on purpose: no exposure is shortened, and there is no warning."""
    scene = load_scene("plane", placement="near")
    motion = {"count": 3, "bracket": (1.0, 4.0, 16.0), "lights": ("lamp", "laser")}
    scene = scene.model_copy(update={"motion": scene.motion.model_copy(update=motion)})
    with serve(scene, sensor=sensor, spp=4, speed_up=50.0) as served:
        assert "saturated" not in scanned(scene, served, folder, tmp_path / "scan.h5")
    with Capture(tmp_path / "scan.h5") as scan:
        assert scan.laser_on.tolist() == [False, True, True, True] * 3
        lit = scan.exposure_ms[scan.laser_on].reshape(3, 3)
        # The camera rounds to whole microseconds.
        np.testing.assert_allclose(lit / lit[:, :1], [[1, 4, 16]] * 3, rtol=0.02)
        assert set(find_stripes(scan).frame.tolist()) == {3, 7, 11}
