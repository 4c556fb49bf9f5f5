"""No light lasts longer than its exposure and a second, whatever fails while it is on.

A real ``uwlts scan`` in a process of its own drives camera and controller over their real protocols. Faults come in the
middle of a light, before its image is sent. The controller's own log says how long it was lit.
"""

import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from tests import preloaded
from tests.preloaded import Preloaded
from tests.system.drawn_hardware import STAGE, DrawnCamera, write_plan
from tests.waiting import within
from twin.devices.gige_camera import ExposedFrame, GigeCamera
from twin.devices.grbl_controller import GrblController
from uwlts.hardware.grbl import GrblStage

pytestmark = pytest.mark.slow

EXPOSURE_MS = 0.09
ALLOWED_S = 1e-3 * EXPOSURE_MS + 1.0
FAULTY_LIGHT = 4
"""Number of the light with a fault."""
PATIENCE_S = 120.0
"""Start of a scan on a busy machine."""
LONGEST_S = 14.0
"""For three tries that are waited for with the laser on."""


class FaultyCamera(DrawnCamera):
    """Calls ``fault`` in the light of that number, before the image is sent; afterwards it may make no more images."""

    def __init__(self) -> None:
        super().__init__()
        self.number, self.hangs, self.ended = 0, False, threading.Event()
        self.fault: Callable[[], object] = lambda: None

    def _drawn(self, exposure_ms: float) -> np.ndarray:
        assert self.controller is not None
        if self.controller.state().laser_on:
            self.number += 1
            if self.number == FAULTY_LIGHT:
                self.fault()
            if self.number >= FAULTY_LIGHT and self.hangs:
                self.ended.wait()
        # Bright enough at this exposure.
        return super()._drawn(5 * exposure_ms)


class Lit:
    """Program that switches the laser of a controller; signals can be sent to it and to its guard."""

    def __init__(self, controller: GrblController, program: Preloaded):
        self.controller, self.program, self._sent = controller, program, []

    def signal(self, number: int, *, guard: bool = False) -> None:
        """Send a signal to the program, after its guard, the only child, if that is to receive it, too."""
        program = self.program.pid
        if guard:
            (child,) = map(int, Path(f"/proc/{program}/task/{program}/children").read_text().split())
            self._sent.append(child)
            os.kill(child, number)
        self._sent.append(program)
        os.kill(program, number)

    def end(self) -> None:
        """End the program, and what was stopped."""
        for process in self._sent:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGCONT)
        self.program.kill()
        self.program.communicate()


class Scan(Lit):
    """A running scan and its camera."""

    def __init__(self, camera: "FaultyCamera | FreeCamera", controller: GrblController, plan: Path):
        super().__init__(controller, preloaded.uwlts("scan", plan, "--out", plan.parent / "scan.h5", "--home"))
        self.camera = camera


@pytest.fixture
def scan(tmp_path: Path) -> Iterator[Scan]:
    camera = FaultyCamera()
    settings = STAGE | {24: 3000, 25: 10000, 120: 1000}
    with GrblController(settings=settings, speed_up=50.0, boot_s=0.2) as controller, camera:
        camera.controller = controller
        plan = write_plan(tmp_path, camera, controller, count=12, step_mm=0.5, laser_ms=f"{EXPOSURE_MS}")
        running = Scan(camera, controller, plan)
        yield running
        camera.ended.set()
        running.end()


def longest_light_s(controller: GrblController) -> float:
    """Duration of the longest light."""
    return max(light.duration_s for light in controller.lights)


def watched(running: Scan) -> float:
    """Wait until the scan has ended or hangs; return the duration of its longest light in s."""
    assert within(PATIENCE_S, lambda: running.camera.number >= FAULTY_LIGHT)
    # Dark for good: also between two tries.
    within(LONGEST_S, lambda: running.program.poll() is not None)
    within(LONGEST_S, lambda: not running.controller.state().laser_on)
    longest_s = longest_light_s(running.controller)
    print(f"longest light {longest_s:.2f} s of {len(running.controller.lights)}")
    return longest_s


CAMERA_FAULTS: dict[str, tuple[Callable[[FaultyCamera], object], str]] = {
    "hang": (lambda camera: setattr(camera, "hangs", True), "did not answer a trigger .* 3 times"),
    "drop": (lambda camera: camera.inject("drop", 100), "did not answer a trigger .* 3 times"),
    "delay": (
        lambda camera: camera.inject("delay", 100, delay_s=2.0),
        "it may have been exposed in the dark .* 3 times",
    ),
    # Its thread waits for the thread of this call.
    "unplug": (
        lambda camera: (threading.Thread(target=camera.disconnect).start(), setattr(camera, "hangs", True)),
        "check power and cable",
    ),
}
"""Faults of the camera, and the words of their errors."""


@pytest.mark.parametrize("fault", CAMERA_FAULTS)
def test_a_camera_that_fails_is_waited_for_in_the_dark(scan, fault):
    inject, says = CAMERA_FAULTS[fault]
    scan.camera.fault = lambda: inject(scan.camera)
    assert watched(scan) <= ALLOWED_S
    _, errors = scan.program.communicate(timeout=20)
    assert scan.program.returncode == 2 and re.search(says, errors), errors


def test_a_scan_survives_several_frames_lost_in_a_row(scan):
    """A busy computer loses them within a fraction of a second."""
    scan.camera.fault = lambda: scan.camera.inject("cut", 6)
    assert watched(scan) <= ALLOWED_S
    _, errors = scan.program.communicate(timeout=20)
    assert scan.program.returncode == 0, errors
    lost = re.search(r"(\d+) images were lost between camera and computer", errors)
    assert lost and int(lost[1]) >= 6, errors


@pytest.mark.parametrize("guard", [False, True], ids=["program", "program and guard"])
@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGSTOP])
def test_processes_that_are_gone_or_stand_still_leave_no_light(scan, stop, guard):
    scan.camera.fault = lambda: scan.signal(stop, guard=guard)
    assert watched(scan) <= ALLOWED_S


@pytest.mark.parametrize("fault", ["mute", "cut-line"])
def test_a_broken_line_leaves_no_light(scan, fault):
    scan.camera.fault = lambda: scan.controller.inject(fault)
    assert watched(scan) <= ALLOWED_S
    _, errors = scan.program.communicate(timeout=20)
    assert scan.program.returncode == 2 and re.search("hangs|does not answer|silence", errors), errors


# Light in motion


SPEED, STEP_MM, TRAVEL_MM = 40.0, 0.5, 300.0
PERIOD_S = STEP_MM / SPEED


class FreeCamera(GigeCamera):
    """Takes frames of a stripe at its own rate, and calls ``fault`` in the frame of that number with laser."""

    def __init__(self, controller: GrblController):
        self.controller, self.number, self.fault_s = controller, 0, np.nan
        self.fault: Callable[[], object] = lambda: None
        super().__init__(lambda exposure_ms: self._drawn(), width_px=96, height_px=512, expose=self._exposed)

    def _exposed(self) -> ExposedFrame:
        if self.controller.state().laser_on:
            self.number += 1
            if self.number == 30:
                self.fault_s = time.monotonic()
                self.fault()
        return ExposedFrame(time.monotonic(), None, lambda exposure_ms: self._drawn())

    def _drawn(self) -> np.ndarray:
        image = np.full((512, 96), 5, np.uint8)
        if self.controller.state().laser_on:
            image[250:253] = 150
        return image


@contextmanager
def passing(tmp_path: Path) -> Iterator[Scan]:
    """A continuous scan in motion."""
    settings = {24: 600, 25: 7200, 100: 100, 110: 7200, 120: 2000, 130: TRAVEL_MM}
    with GrblController(settings=settings, boot_s=0.2) as controller, FreeCamera(controller) as camera:
        path = write_plan(tmp_path, camera, controller, count=481, step_mm=STEP_MM, laser_ms=f"{EXPOSURE_MS}")
        path.write_text(
            path.read_text()
            .replace("start_mm = 5.0", "start_mm = 25.0")
            .replace("[stage]", f"check_steps = false\ncontinuous = {{ speed_mm_per_s = {SPEED} }}\n[stage]")
        )
        sensor = tmp_path / "sensor.toml"
        sensor.write_text(sensor.read_text().replace("travel_mm = 120.0", f"travel_mm = {TRAVEL_MM}"))
        running = Scan(camera, controller, path)
        try:
            yield running
        finally:
            running.end()


PASS_FAULTS: dict[str, Callable[[Scan], object]] = {
    "kill": lambda scan: scan.signal(signal.SIGKILL),
    "kill both": lambda scan: scan.signal(signal.SIGKILL, guard=True),
    "stop both": lambda scan: scan.signal(signal.SIGSTOP, guard=True),
    "mute": lambda scan: scan.controller.inject("mute"),
    "cut-line": lambda scan: scan.controller.inject("cut-line"),
    "drop": lambda scan: scan.camera.inject("drop", 10000),
    "unplug": lambda scan: threading.Thread(target=scan.camera.disconnect).start(),
}


NOTICED = {"drop": 3, "unplug": 3}
"""Attempts for a fault that the program must notice, which a busy machine delays. The controller ends other light."""


@pytest.mark.parametrize("fault", PASS_FAULTS)
def test_the_laser_goes_off_on_the_way(tmp_path, fault):
    """The image after the fault should have been taken a period later."""
    dark_s = []
    while len(dark_s) < NOTICED.get(fault, 1) and min(dark_s, default=LONGEST_S) > PERIOD_S + ALLOWED_S:
        folder = tmp_path / str(len(dark_s))
        folder.mkdir()
        with passing(folder) as scan:
            scan.camera.fault = lambda scan=scan: PASS_FAULTS[fault](scan)
            assert within(PATIENCE_S, lambda scan=scan: scan.camera.number >= 30)
            within(LONGEST_S, lambda scan=scan: not scan.controller.state().laser_on)
            dark_s.append(dark_after_s(scan.controller, scan.camera.fault_s))
    assert min(dark_s) <= PERIOD_S + ALLOWED_S


def dark_after_s(controller: GrblController, fault_s: float) -> float:
    """Time in s from a fault until the laser was off for good, or until now."""
    last = controller.lights[-1]
    after_s = (time.monotonic() if last.off_s is None else last.off_s) - fault_s
    print(f"dark {after_s:.2f} s after the fault")
    return after_s


# Light that is kept


def keep_lit(port: str) -> None:
    """Renew a light for ever."""
    with GrblStage(port) as stage:
        stage.home()
        stage.laser(True)
        for _ in range(8):
            time.sleep(0.25)
            stage.keep_lit()
        print("lit", flush=True)
        while True:
            time.sleep(0.25)
            stage.keep_lit()


@pytest.mark.parametrize("fault", ["kill both", "stop both", "mute", "cut-line"])
def test_light_that_is_kept_ends_within_a_second_of_its_last_renewal(fault):
    with GrblController(speed_up=50.0, boot_s=0.2) as controller:
        keeping = Lit(controller, Preloaded(keep_lit, controller.port))
        try:
            assert keeping.program.stdout.readline() == "lit\n"
            # It lasts, but for the ms between two dwells.
            assert controller.state().laser_on and sum(light.duration_s for light in controller.lights) > 1.5
            match fault:
                case "kill both" | "stop both":
                    keeping.signal(signal.SIGKILL if fault == "kill both" else signal.SIGSTOP, guard=True)
                case _:
                    controller.inject(fault)
            failed_s = time.monotonic()
            within(4.0, lambda: not controller.state().laser_on)
            assert dark_after_s(controller, failed_s) <= 1.0
        finally:
            keeping.end()
