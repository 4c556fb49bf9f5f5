"""The laser goes off within its exposure and 1 s whatever stops a scan: suspended, killed, hung, or its guard killed.

A real ``uwlts scan`` runs in a process of its own at the twin's controller, whose laser pin is watched from here. The
camera draws a stripe where the driver says that the laser is on, and hangs where a test asks for it.
"""

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import preloaded
from tests.preloaded import Preloaded
from tests.system.small_board import small_sensor
from twin.devices.grbl_controller import GrblController
from uwlts.desk import scan as scanning
from uwlts.hardware.camera_interface import CameraDevice, CameraInfo, Delivered
from uwlts.hardware.grbl import GrblStage
from uwlts.storage.capture import Capture, part_path

pytestmark = pytest.mark.slow

EXPOSURE_S = 0.5
ALLOWED_S = EXPOSURE_S + 1.0
LOAD_S = 0.5
"""Allowance for busy machines, where a ready process does not run at once. The guard itself needs some ms."""
COUNT = 4


class Stage(GrblStage):
    """The stage that was opened last is `opened`; ``hangs`` is where the camera's driver hangs."""

    opened: "Stage"
    hangs = ""

    def __init__(self, port: str):
        super().__init__(port)
        Stage.opened = self

    def laser(self, on: bool, **how: Any) -> None:
        super().laser(on, **how)
        if not on and self.hangs == "lost":
            # Dark for long enough to be seen from outside, before the next try.
            time.sleep(0.3)


class Camera(CameraDevice):
    """Draws a stripe where the stage's driver says that the laser is on."""

    number, due_s, lit = 0, None, False

    def _open(self) -> CameraInfo:
        return CameraInfo("drawn", "1", 96, 512, 8)

    def _configure(self, wanted: Any) -> Any:
        return wanted

    def _close(self) -> None: ...

    def _start(self) -> None: ...

    def _stop(self) -> None: ...

    def _check_answer(self) -> None: ...

    def _trigger(self) -> None:
        self.lit = Stage.opened.laser_power > 0
        if self.lit:
            print("lit", Stage.opened._guard.pid, flush=True)
        if self.lit and Stage.hangs == "trigger":
            time.sleep(60)
        self.due_s = time.monotonic() + 1e-3 * self.settings.exposure_ms

    def _take_next(self, timeout_s: float) -> Delivered | None:
        if self.due_s is None:
            return None
        if self.lit and Stage.hangs == "frame":
            time.sleep(60)
        if Stage.hangs == "lost":
            time.sleep(timeout_s)
            return None
        time.sleep(min(timeout_s, max(self.due_s - time.monotonic(), 0)))
        if time.monotonic() < self.due_s:
            return None
        self.due_s, self.number = None, self.number + 1
        image = np.random.default_rng(self.number).integers(3, 7, (512, 96), np.uint8)
        if self.lit:
            image[250:253] = [[90], [180], [90]]
        return Delivered(image, self.number)


def run_scan(hangs: str, *words: str) -> None:
    """Run the command with this stage and camera, in a job of its own, as a shell starts it, in the same session."""
    os.setpgid(0, 0)
    Stage.hangs, scanning.GrblStage, scanning.open_camera = hangs, Stage, Camera
    preloaded.run_uwlts(*words)


@pytest.fixture
def controller() -> Iterator[GrblController]:
    with GrblController(speed_up=50.0, boot_s=0.5, position_mm=30.0) as running:
        yield running


@dataclass
class Scanning:
    """A running scan whose laser has just been switched on for an image, and its guard's process."""

    program: Preloaded
    controller: GrblController
    out: Path

    def lit(self) -> int:
        """Wait for the next laser image; the guard's process."""
        for line in self.program.stdout:
            if found := re.fullmatch(r"lit (\d+)\n", line):
                assert self.controller.state().laser_on
                return int(found[1])
        raise AssertionError(self.program.communicate()[1])

    def dark_after_s(self, *, at_most_s: float = ALLOWED_S) -> float:
        """Time in s until the controller's laser pin is off.

        Delays of this process are added as an allowance, because the machine delays the others as well.
        """
        began = before = time.monotonic()
        late_s = 0.0
        while self.controller.state().laser_on:
            time.sleep(0.002)
            now = time.monotonic()
            late_s += max(now - before - 0.01, 0.0)
            before = now
            assert now - began < at_most_s + LOAD_S + late_s, "the laser is still on"
        return time.monotonic() - began

    def ended(self, code: int, says: str) -> None:
        _, errors = self.program.communicate(timeout=20)
        assert self.program.returncode == code, errors
        assert re.search(says, errors), errors


StartScan = Callable[..., Scanning]


@pytest.fixture
def start(controller: GrblController, tmp_path: Path) -> Iterator[StartScan]:
    (tmp_path / "sensor.toml").write_text(small_sensor("settling_s = 0.0"), encoding="utf-8")
    (tmp_path / "plan.toml").write_text(
        'title = "Guard"\nsensor = "sensor.toml"\nmedium = "air"\ncamera = "drawn"\ncheck_steps = false\n'
        f'laser_ms = {1e3 * EXPOSURE_S}\n[stage]\nport = "{controller.port}"\nstart_mm = 5.0\nstep_mm = 1.0\n'
        f"count = {COUNT}\nfeed_mm_per_min = 900.0\n",
        encoding="utf-8",
    )
    running: list[Preloaded] = []

    def scan(*more: str, hangs: str = "") -> Scanning:
        out = tmp_path / "scan.h5"
        words = ("scan", str(tmp_path / "plan.toml"), "--out", str(out), "--home", *more)
        running.append(Preloaded(run_scan, hangs, *words))
        return Scanning(running[-1], controller, out)

    yield scan
    for program in running:
        program.kill()
        program.communicate()


def state_of(process: int) -> str:
    """Letter of the process's state: T where it is stopped."""
    return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]


@pytest.mark.parametrize("stop", [signal.SIGSTOP, signal.SIGTSTP])
def test_a_suspended_scan_is_dark_and_ends_when_it_is_continued(start, stop):
    scan = start()
    scan.lit()
    guard = scan.lit()
    time.sleep(EXPOSURE_S / 2)
    # As the terminal's Ctrl-Z does: all processes of the job.
    os.killpg(scan.program.pid, stop)
    print(f"dark after {scan.dark_after_s():.3f} s")
    assert state_of(scan.program.pid) == "T" and state_of(guard) != "T"
    # The controller has ended the light; the guard waits for 0.8 s beyond the exposure.
    time.sleep(EXPOSURE_S + 0.8)
    os.killpg(scan.program.pid, signal.SIGCONT)
    scan.ended(2, "guard switched the laser off.*suspended")
    assert not scan.controller.state().laser_on
    with Capture(part_path(scan.out)) as capture:
        kept = len(capture)
    assert kept == 1
    again = start("--resume")
    again.program.stdout.read()
    again.ended(0, "")
    with Capture(scan.out) as capture:
        assert capture.stage_mm.tolist() == [5.0, 6.0, 7.0, 8.0]


def test_a_scan_that_is_suspended_in_the_dark_goes_on(start):
    # The signal may come while the scan prepares to switch the laser on: it ends then, as after one in the light.
    for _ in range(5):
        scan = start("--overwrite")
        suspend_in_the_dark(scan)
        time.sleep(1.5)
        scan.program.send_signal(signal.SIGCONT)
        scan.program.stdout.read()
        _, errors = scan.program.communicate(timeout=20)
        if not re.search("guard switched the laser off|restarted by itself", errors):
            break
    assert scan.program.returncode == 0, errors


def suspend_in_the_dark(scan: Scanning) -> None:
    """Suspend a scan between two images; raises AssertionError if every signal came during an image."""
    for _ in range(COUNT):
        scan.lit()
        # The frame, and the switching off after it.
        while scan.controller.state().laser_on:
            time.sleep(0.002)
        scan.program.send_signal(signal.SIGSTOP)
        if not scan.controller.state().laser_on:
            return
        # The next image has begun before the signal came: continue before its guard finds the program late.
        scan.program.send_signal(signal.SIGCONT)
    raise AssertionError("every signal came during an image")


def test_a_killed_scan_is_dark(start):
    scan = start()
    scan.lit()
    scan.program.kill()
    print(f"dark after {scan.dark_after_s():.3f} s")


@pytest.mark.parametrize("hangs", ["trigger", "frame"])
def test_a_scan_that_hangs_in_the_cameras_driver_is_dark(start, hangs):
    scan = start(hangs=hangs)
    scan.lit()
    print(f"dark after {scan.dark_after_s():.3f} s")
    assert scan.program.poll() is None


def test_a_frame_that_does_not_come_leaves_no_laser_on(start):
    """The scan waits for 3 s beyond the exposure, in the dark."""
    scan = start(hangs="lost")
    scan.lit()
    print(f"dark after {scan.dark_after_s():.3f} s")
    scan.lit()
    scan.lit()
    scan.program.stdout.read()
    scan.ended(2, "did not answer a trigger.*tried 3 times")


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP])
def test_without_its_guard_a_scan_is_dark_and_ends(start, ending):
    scan = start()
    guard = scan.lit()
    os.kill(guard, ending)
    print(f"dark after {scan.dark_after_s(at_most_s=1.0):.3f} s")
    scan.program.stdout.read()
    scan.ended(2, "guard process, which switches the laser off .* is gone")


def test_without_any_process_the_controller_switches_the_laser_off(start):
    """By the line that was sent together with the one that switched the laser on."""
    scan = start()
    guard = scan.lit()
    os.kill(guard, signal.SIGKILL)
    scan.program.kill()
    print(f"dark after {scan.dark_after_s():.3f} s")


def test_both_processes_may_be_asked_to_end_at_once(start):
    """As at a shutdown of the computer."""
    scan = start()
    guard = scan.lit()
    os.kill(guard, signal.SIGTERM)
    scan.program.send_signal(signal.SIGTERM)
    print(f"dark after {scan.dark_after_s(at_most_s=0.0):.3f} s")
