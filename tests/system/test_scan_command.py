"""Scans by the command with the twin as the hardware, through the real drivers: the same cloud as a simulated one."""

import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import uwlts
from tests import preloaded
from tests.system import in_process
from tests.system.small_board import small_sensor, turned_board
from tests.waiting import within
from twin.devices.serve import ServedTwin, serve
from twin.recording.record_scene import record_scene
from twin.rendering_options import Options
from twin.scene.description import Scene
from uwlts.errors import CaptureError
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture, part_path
from uwlts.stripe import extract_stripe

COUNT = 6
MOTION = ("start_mm = -5.0", "step_mm = 2.0", f"count = {COUNT}")
DESCRIPTIONS = {
    "sensor": small_sensor("travel_mm = 120.0", "resolution_mm = 0.01", "settling_s = 0.0"),
    "board": turned_board(*MOTION, more=("[artefact]", 'kind = "plane"')),
}


@pytest.fixture(scope="module")
def served(board: Scene, sensor: Sensor) -> Iterator[ServedTwin]:
    with serve(board, sensor=sensor, spp=4, speed_up=50.0) as running:
        yield running


def written(folder: Path, served: ServedTwin, *, name: str = "plan", top: str = "", **stage: object) -> Path:
    """A plan for the served twin, with the given changes."""
    values = {"start_mm": served.track.start_mm, "step_mm": 2.0, "count": COUNT, "feed_mm_per_min": 900.0} | stage
    lines = "\n".join(f"{key} = {value}" for key, value in values.items())
    path = folder / f"{name}.toml"
    path.write_text(
        f'title = "Board"\nsensor = "sensor.toml"\nmedium = "air"\ncamera = "{served.camera.address}"\n{top}\n'
        f'[stage]\nport = "{served.controller.port}"\n{lines}\n[artefact]\nkind = "plane"\n',
        encoding="utf-8",
    )
    return path


def run(plan: Path, out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return in_process.uwlts("scan", plan, "--out", out, *(more or ["--home"]))


def dark(served: ServedTwin) -> bool:
    """Return whether the laser goes off within a second."""
    return within(1.0, lambda: not served.controller.state().laser_on)


def centres(image: np.ndarray) -> np.ndarray:
    return extract_stripe(image, stripe_along="width").centre_px


@pytest.mark.slow
def test_a_scan_of_the_served_twin_is_the_simulated_one(served, folder, board, sensor, tmp_path):
    exposure = served.exposure_ms["laser"]
    done = run(written(folder, served, top=f"laser_ms = {exposure}"), tmp_path / "scan.h5")
    assert done.returncode == 0, done.stderr
    assert dark(served)
    record_scene(board, sensor, tmp_path / "simulated.h5", options=Options(spp=4))
    with Capture(tmp_path / "scan.h5") as scan, Capture(tmp_path / "simulated.h5") as simulated:
        assert len(scan) == len(simulated) == COUNT
        assert scan.laser_on.all()
        # The stage's steps are 0.01 mm; positions are read back from it.
        np.testing.assert_allclose(scan.stage_mm - served.track.offset_mm, simulated.stage_mm, atol=0.011)
        # The camera exposes whole microseconds, and says so.
        np.testing.assert_allclose(scan.exposure_ms, exposure, atol=1e-3)
        assert (np.diff(scan.time_s) > 0).all()
        assert scan.header.artefact == {"kind": "plane"} and scan.header.provenance["source"] == "scan"
        for (_, ours), (_, theirs) in zip(scan.frames(), simulated.frames(), strict=True):
            apart = np.abs(centres(ours) - centres(theirs))
            assert np.isfinite(apart).mean() > 0.9 and np.nanmedian(apart) < 0.05
    clouds = []
    for name in ("scan", "simulated"):
        for line in (
            f"nominal {folder / 'sensor.toml'} --medium air --out {tmp_path / name}.json",
            f"reconstruct {tmp_path / name}.h5 --calibration {tmp_path / name}.json --out {tmp_path / name}.cloud.h5",
            f"evaluate {tmp_path / name}.cloud.h5 --out {tmp_path / name}.evaluation.json",
        ):
            judged = in_process.uwlts(*line.split())
            assert judged.returncode == 0, judged.stderr
        clouds.append((tmp_path / f"{name}.evaluation.json").read_text())
    # The served images have other noise than the simulated ones, so that the spreads differ randomly.
    spreads = [float(re.search(r'"STD": ([0-9.e-]+)', text)[1]) for text in clouds]
    assert spreads[0] == pytest.approx(spreads[1], rel=0.25)


@pytest.mark.slow
def test_automatic_exposure_comes_near_that_of_the_twin(served, folder, tmp_path):
    done = run(written(folder, served, count=2), tmp_path / "scan.h5")
    assert done.returncode == 0, done.stderr
    with Capture(tmp_path / "scan.h5") as scan:
        # Both bring all but 2 % of the lines to 80 % of the full scale, here with noise and within 10 %.
        assert scan.exposure_ms[0] == pytest.approx(served.exposure_ms["laser"], rel=0.3)
        assert scan.exposure_ms[0] == scan.exposure_ms[1]


def test_background_is_subtracted_and_lamp_images_are_kept(served, folder, tmp_path):
    top = 'background = true\nlights = ["lamp", "laser"]\nlaser_ms = 0.3\nlamp_ms = 0.3'
    done = run(written(folder, served, top=top, count=2), tmp_path / "scan.h5")
    assert done.returncode == 0, done.stderr
    with Capture(tmp_path / "scan.h5") as scan:
        assert scan.laser_on.tolist() == [False, True, False, True]
        assert scan.dtype == np.uint16 and scan.header.saturation_dn == 511
        _, lamp = next(iter(scan.frames()))
        laser = scan[1].image
        assert lamp.max() < 256
        # Away from the stripe the difference is noise about 256, which represents zero.
        assert np.median(laser) == pytest.approx(256, abs=1) and laser.max() > 300


@pytest.mark.slow
def test_an_interrupted_scan_is_dark_keeps_its_images_and_goes_on(served, folder, tmp_path):
    out = tmp_path / "scan.h5"
    plan = written(folder, served, top="laser_ms = 0.3", settle_s=0.4)
    scanning = preloaded.uwlts("scan", plan, "--out", out, "--home")
    deadline = time.monotonic() + 60
    while True:
        assert time.monotonic() < deadline
        time.sleep(0.05)
        if part_path(out).exists():
            with Capture(part_path(out)) as part:
                if len(part) >= 2:
                    break
    scanning.send_signal(signal.SIGINT)
    _, said = scanning.communicate(timeout=20)
    assert scanning.returncode == 130 and "Traceback" not in said
    assert dark(served)
    assert not out.exists()
    with Capture(part_path(out)) as part:
        kept, times = len(part), part.time_s[:]
    assert 2 <= kept < COUNT
    assert "--resume" in run(plan, out).stderr
    done = run(plan, out, "--home", "--resume")
    assert done.returncode == 0, done.stderr
    with Capture(out) as scan:
        assert len(scan) == COUNT
        np.testing.assert_array_equal(scan.time_s[:kept], times)
        assert (np.diff(scan.time_s) > 0).all()
        np.testing.assert_allclose(np.diff(scan.stage_mm), 2.0, atol=0.021)


@pytest.mark.parametrize(
    ("stage", "top", "says"),
    [
        ({"count": 400}, "", "the stage moves from 0 to"),
        ({"feed_mm_per_min": 1e6}, "", "the stage does at most"),
        ({"step": 1.0}, "", "unknown key"),
        ({}, 'lights = ["moon"]', "lights"),
        ({}, 'laser_ms = "long"', "laser_ms"),
        ({"direction": "[0, 0, 0]"}, "", "no length"),
    ],
)
def test_plans_that_cannot_be_done_are_refused_before_anything_moves(served, folder, tmp_path, stage, top, says):
    before = served.controller.state().position_mm
    plan = written(folder, served, name="wrong", top=top, **stage)
    done = run(plan, tmp_path / "scan.h5", "--unlock")
    assert done.returncode == 2
    assert says in done.stderr and "Traceback" not in done.stderr
    assert served.controller.state().position_mm == before and not (tmp_path / "scan.h5").exists()


def test_a_scan_is_resumed_only_by_its_own_plan(served, folder, tmp_path):
    out = tmp_path / "scan.h5"

    def stop(done: int, _: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    plan = written(folder, served, top="laser_ms = 0.3")
    with pytest.raises(KeyboardInterrupt):
        uwlts.scan(plan, out, home=True, progress=stop)
    before = part_path(out).read_bytes()
    for changed, says in (
        (
            written(folder, served, name="farther", top="laser_ms = 0.3", step_mm=3.0),
            "plan.stage.step_mm is 2.0 in it, 3.0",
        ),
        (written(folder, served, name="longer", top="laser_ms = 0.5"), "plan.laser_ms is 0.3 in it, 0.5 now"),
    ):
        with pytest.raises(CaptureError, match=re.escape(says)):
            uwlts.scan(changed, out, home=True, resume=True)
        assert part_path(out).read_bytes() == before
    slower = written(folder, served, name="slower", top="laser_ms = 0.3\ncheck_steps = false", feed_mm_per_min=600.0)
    uwlts.scan(slower, out, home=True, resume=True)
    with Capture(out) as scan:
        assert len(scan) == COUNT


def test_another_camera_than_described_is_refused(served, folder, tmp_path):
    (folder / "other.toml").write_text(DESCRIPTIONS["sensor"].replace("96", "128"), encoding="utf-8")
    plan = written(folder, served, name="other-plan")
    plan.write_text(plan.read_text().replace("sensor.toml", "other.toml"), encoding="utf-8")
    done = run(plan, tmp_path / "scan.h5")
    assert done.returncode == 2 and "96 x 512 px" in done.stderr and "128 x 512" in done.stderr
