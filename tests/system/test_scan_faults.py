"""All faults of camera, stage and laser in real runs of ``uwlts scan`` at a served twin."""

import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.system.in_process import uwlts
from tests.system.small_board import small_sensor, turned_board
from tests.waiting import within
from twin.devices.serve import NAMES, ServedTwin, serve
from twin.scene.description import Scene, load_scene
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture, part_path

pytestmark = pytest.mark.slow

STEP_MM = 2.0
MOTION = ("start_mm = -20.0", "step_mm = 2.0", "count = 21")
DESCRIPTIONS = {
    "sensor": small_sensor("travel_mm = 160.0", "resolution_mm = 0.01", "settling_s = 0.0"),
    "board": turned_board(*MOTION),
    # Half of the scan passes a narrow board: the stripe is correctly absent at both ends.
    "narrow": turned_board(*MOTION, width_mm=20.0),
}

STAGE_FAULTS = {
    "stall": "stall: the stage has been at",
    "stop-short:200": "missed steps: the position is .* where",
    "alarm:1": "ALARM:1",
    "hold": "feed hold|is held",
    "restart": "restarted by itself",
    "garbage": "garbage on the line",
    "mute": "the controller hangs|does not answer",
    "cut-line": "the controller hangs|does not answer",
    "break-laser": "the laser has failed: at .*, where its stripe was seen before",
}
"""Faults that end a scan, and the words of the message."""
LOST_FRAMES = {"drop": 1, "cut": 2, "repeat": 1, "delay:4": 1}
"""Faults after which the image is requested again, and their number here."""


@contextmanager
def serving(scene: Scene, sensor: Sensor, *faults: str) -> Iterator[ServedTwin]:
    with serve(scene, sensor=sensor, spp=4, speed_up=50.0, fault=faults) as running:
        yield running


def written(folder: Path, served: ServedTwin, *, count: int, laser_ms: float | str | None = None) -> Path:
    laser_ms = served.exposure_ms["laser"] if laser_ms is None else laser_ms
    path = folder / "plan.toml"
    path.write_text(
        f'title = "Board"\nsensor = "sensor.toml"\nmedium = "air"\ncamera = "{served.camera.address}"\n'
        f"laser_ms = {laser_ms!r}\n".replace("'", '"')
        + f'[stage]\nport = "{served.controller.port}"\nstart_mm = {served.track.start_mm}\nstep_mm = {STEP_MM}\n'
        f"count = {count}\nfeed_mm_per_min = 900.0\n",
        encoding="utf-8",
    )
    return path


def scan(plan: Path, out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return uwlts("scan", plan, "--out", out, "--home", *more)


def dark(served: ServedTwin) -> bool:
    """Return whether the laser goes off within a second."""
    return within(1.0, lambda: not served.controller.state().laser_on)


def ended(done: subprocess.CompletedProcess[str], says: str) -> None:
    """One line informs the user."""
    errors = [line for line in done.stderr.splitlines() if line.strip()]
    assert done.returncode == 2, done.stderr
    assert len(errors) == 1 and errors[0].startswith("error:"), done.stderr
    assert re.search(says, errors[0]), errors[0]


def positions(path: Path) -> np.ndarray:
    with Capture(path) as capture:
        for number in range(len(capture)):
            # Every image that is kept can be read, and has the stripe: the board fills the image.
            assert capture.image(number).max() > 100
        return capture.stage_mm.copy()


def planned(served: ServedTwin, count: int) -> np.ndarray:
    return served.track.start_mm + STEP_MM * np.arange(count)


def test_a_scan_meets_one_fault_after_the_other_and_goes_on_after_each(board, sensor, folder, tmp_path):
    """Each run confirms its first image by one without laser, and takes the next one, where the fault occurs."""
    names, out = list(STAGE_FAULTS), tmp_path / "scan.h5"
    count = 2 * len(names) + 1
    faults = [f"{name}@{3 * (k + 1)}" for k, name in enumerate(names)]
    with serving(board, sensor, *faults) as served:
        plan, kept = written(folder, served, count=count), 0
        for name in names:
            done = scan(plan, out, *(["--resume"] if kept else []))
            ended(done, STAGE_FAULTS[name])
            served.controller.inject("cut-line", 0)
            served.controller.inject("break-laser", 0)
            assert dark(served), name
            assert not out.exists()
            found = positions(part_path(out))
            # A fault during an image may cost this image, but no other.
            assert kept < len(found) <= kept + 2, name
            np.testing.assert_allclose(found, planned(served, len(found)), atol=0.011)
            kept = len(found)
        done = scan(plan, out, "--resume")
        assert done.returncode == 0, done.stderr
        assert dark(served)
    np.testing.assert_allclose(positions(out), planned(served, count), atol=0.011)
    with Capture(out) as capture:
        assert (np.diff(capture.time_s) > 0).all() and not part_path(out).exists()


def test_frames_lost_on_their_way_are_taken_again(board, sensor, folder, tmp_path):
    """The first image, its comparison without laser, then one frame for each position and each that was lost."""
    out, faults, frame = tmp_path / "scan.h5", [], 3
    for name, lost in LOST_FRAMES.items():
        faults.append(f"{name}{f':{lost}' if lost > 1 else ''}@{frame}")
        frame += lost + 1
    count = len(LOST_FRAMES) + 2
    said: list[str] = []
    with serve(board, sensor=sensor, spp=4, speed_up=50.0, fault=faults, report=said.append) as served:
        done = scan(written(folder, served, count=count), out)
        assert done.returncode == 0, done.stderr
        assert dark(served)
        assert len(said) == len(faults)
        np.testing.assert_allclose(positions(out), planned(served, count), atol=0.011)
    # Images that a busy machine renders later than the light lasts may be taken again, too.
    assert int(re.search(r"(\d+) images were lost", done.stderr)[1]) >= sum(LOST_FRAMES.values())


def test_a_camera_that_loses_every_frame_ends_the_scan(board, sensor, folder, tmp_path):
    with serving(board, sensor, "cut:10000@3") as served:
        plan, out = written(folder, served, count=4), tmp_path / "scan.h5"
        ended(scan(plan, out), r"incomplete: packets were lost.* \d+ times")
        assert dark(served)
        served.camera.inject("cut", 0)
        np.testing.assert_allclose(positions(part_path(out)), planned(served, 1), atol=0.011)
        assert scan(plan, out, "--resume").returncode == 0
        np.testing.assert_allclose(positions(out), planned(served, 4), atol=0.011)


def test_a_camera_that_goes_and_a_stage_that_goes_end_the_scan(board, sensor, folder, tmp_path):
    out = tmp_path / "scan.h5"
    with serving(board, sensor, "camera-disconnect@3", "stage-disconnect@6") as served:
        plan = written(folder, served, count=6)
        ended(scan(plan, out), "the camera .* check power and cable")
        assert dark(served)
        kept = positions(part_path(out))
        np.testing.assert_allclose(kept, planned(served, 1), atol=0.011)
        served.camera.connect()
        ended(scan(plan, out, "--resume"), "connection|gone|lost")
        kept = positions(part_path(out))
        np.testing.assert_allclose(kept, planned(served, len(kept)), atol=0.011)
        assert 1 < len(kept) < 6 and not served.controller.state().laser_on
    with serving(board, sensor) as served:
        assert scan(written(folder, served, count=6), out, "--resume").returncode == 0
        np.testing.assert_allclose(positions(out), planned(served, 6), atol=0.011)


@pytest.mark.parametrize("laser_ms", [None, "auto"])
def test_a_laser_that_never_lights_is_noticed_before_anything_is_stored(board, sensor, folder, tmp_path, laser_ms):
    out = tmp_path / "scan.h5"
    with serving(board, sensor, "break-laser@1") as served:
        plan = written(folder, served, count=4, laser_ms=laser_ms)
        ended(scan(plan, out), "no laser light at any of 4 positions")
        assert not part_path(out).exists()
        served.controller.inject("break-laser", 0)
        assert dark(served)
        assert scan(plan, out, "--resume").returncode == 0
        np.testing.assert_allclose(positions(out), planned(served, 4), atol=0.011)


def test_an_object_out_of_view_is_no_broken_laser(folder, sensor, tmp_path):
    """The narrow board is in the sheet for the middle third of the positions only; daylight is always there."""
    out = tmp_path / "scan.h5"
    with serving(load_scene(folder / "narrow.toml"), sensor) as served:
        done = scan(written(folder, served, count=21), out)
        assert done.returncode == 0, done.stderr
        assert dark(served)
        with Capture(out) as capture:
            seen = np.array([capture.image(k).max() > 60 for k in range(21)])
            np.testing.assert_allclose(capture.stage_mm, planned(served, 21), atol=0.011)
    assert not seen[:4].any() and not seen[-4:].any() and seen[8:13].all()


@pytest.mark.parametrize("steps", [20, -20])
def test_steps_that_the_motor_loses_show_at_the_end(board, sensor, folder, tmp_path, steps):
    """The controller cannot detect it, but the board is tilted, so that the stripe shows the stage's position."""
    out = tmp_path / "scan.h5"
    with serving(board, sensor, f"lose-steps:{steps}@5") as served:
        plan = written(folder, served, count=6)
        done = scan(plan, out)
        ended(done, "the stage has lost steps")
        # The third image, which shows the stripe's motion, was taken before the slip. Noise of 0.2 px on 96 lines with
        # a motion of 3 px/mm is 0.02 mm, including the correlation of neighbouring lines.
        stood_mm, error_mm = map(
            float, re.search(r"displacement of the stage of (\S+) mm \(std (\S+) mm\)", done.stderr).groups()
        )
        assert stood_mm == pytest.approx(steps * sensor.stage.resolution_mm, abs=0.04) and error_mm < 0.03
        assert dark(served)
        assert not out.exists() and len(positions(part_path(out))) == 6
        assert scan(plan, out, "--resume").returncode == 0
        np.testing.assert_allclose(positions(out), planned(served, 6), atol=0.011)


def test_every_fault_is_met_here():
    met = {text.split(":")[0] for text in (*STAGE_FAULTS, *LOST_FRAMES)}
    assert set(NAMES) - met == {"camera-disconnect", "stage-disconnect", "lose-steps"}
