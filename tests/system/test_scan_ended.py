"""A scan that is ended from outside, or whose hardware or disk fails, at any moment.

The laser is off afterwards, what was recorded can be read, and the scan is resumed to the whole capture. Camera and
controller speak their real protocols.
"""

import re
import resource
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from tests import preloaded
from tests.preloaded import Preloaded
from tests.system.drawn_hardware import STAGE, START_MM, DrawnCamera, write_plan
from tests.system.in_process import uwlts
from tests.waiting import within
from twin.devices.grbl_controller import GrblController
from uwlts.storage.capture import Capture, part_path

pytestmark = pytest.mark.slow

COUNT, STEP_MM = 6, 2.0
MANY = 30
"""Images of a scan that is always ended from outside first."""
LAST_MM = START_MM + STEP_MM * (COUNT - 1)


@pytest.fixture(scope="module")
def camera() -> Iterator[DrawnCamera]:
    with DrawnCamera() as running:
        yield running


class Bench:
    """The hardware with a plan for it, and the capture that is recorded."""

    def __init__(self, camera: DrawnCamera, folder: Path, stack: ExitStack):
        self.camera, self.folder, self.out, self._stack = camera, folder, folder / "scan.h5", stack
        self.new_controller()
        camera.lit, self._farthest_mm = 0, 0.0

    def new_controller(self) -> None:
        # Homing that is never acknowledged is given up by the time that these speeds need.
        controller = GrblController(settings=STAGE | {24: 3000, 25: 10000, 120: 1000}, speed_up=50.0, boot_s=0.2)
        self.controller = self.camera.controller = self._stack.enter_context(controller)

    def plan(self, *, count: int = COUNT, laser_ms: str = "0.4") -> Path:
        return write_plan(self.folder, self.camera, self.controller, count=count, step_mm=STEP_MM, laser_ms=laser_ms)

    def words(self, plan: Path) -> list[str]:
        """A scan's arguments: resumed where something is left of it."""
        return ["scan", str(plan), "--out", str(self.out), "--home", *(["--resume"] if self.kept() is not None else [])]

    def start(self, plan: Path, *, largest_file: int | None = None) -> Preloaded:
        """A scan in a process of its own; ``largest_file`` in bytes stands for a disk that is full."""
        if largest_file is None:
            program = preloaded.uwlts(*self.words(plan))
        else:
            program = Preloaded(run_on_full_disk, str(largest_file), *self.words(plan))
        self._stack.callback(program.communicate)
        self._stack.callback(program.kill)
        return program

    def wait(self, program: Preloaded, lights: int) -> None:
        """Wait until a running scan has taken this many further images with laser."""
        wanted = self.camera.lit + lights
        assert within(30.0, lambda: self.camera.lit >= wanted or program.poll() is not None)

    def lit(self) -> bool:
        return self.controller.state().laser_on

    def moving(self) -> bool:
        return self.controller.state().moving

    def going_back(self) -> bool:
        """Return whether the stage has left the last position after an image there."""
        position = self.controller.state().position_mm
        if self.camera.lit:
            self._farthest_mm = max(self._farthest_mm, position)
        return self._farthest_mm > LAST_MM - 0.01 and self.camera.lit >= COUNT and position < LAST_MM - 0.1

    def dark(self) -> bool:
        """Return whether the laser goes off within a second of its exposure."""
        return within(1.0, lambda: not self.lit())

    def kept(self) -> int | None:
        """Return the images left by an interrupted scan, all of them readable; None without a file."""
        if not part_path(self.out).exists():
            return None
        return self._complete(part_path(self.out))

    @staticmethod
    def _complete(path: Path) -> int:
        with Capture(path) as capture:
            for number in range(len(capture)):
                assert capture.image(number).max() > 100
            np.testing.assert_allclose(capture.stage_mm, START_MM + STEP_MM * np.arange(len(capture)), atol=0.002)
            assert (np.diff(capture.time_s) > 0).all()
            return len(capture)

    def completed(self, count: int = COUNT, **plan: str) -> None:
        """Resume the scan with the remaining images, and check that the capture is complete."""
        if not self.out.exists():
            done = uwlts(*self.words(self.plan(count=count, **plan)))
            assert done.returncode == 0, done.stderr
        assert self._complete(self.out) == count and not part_path(self.out).exists()


def run_on_full_disk(largest_file: str, *words: str) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(largest_file),) * 2)
    preloaded.run_uwlts(*words)


@pytest.fixture
def bench(camera: DrawnCamera, tmp_path: Path) -> Iterator[Bench]:
    camera.connect()
    with ExitStack() as stack:
        yield Bench(camera, tmp_path, stack)


def test_a_scan_killed_at_six_moments_loses_nothing(bench):
    """Each run is killed some ms after the laser's first, second or fourth light: in it or after it."""
    kept, plan = 0, bench.plan(count=MANY)
    moments = [(1, 0), (2, 3), (4, 10), (2, 30), (1, 10), (4, 0)]
    for light, after_ms in moments:
        program = bench.start(plan)
        bench.wait(program, light)
        time.sleep(1e-3 * after_ms)
        program.kill()
        assert program.wait() == -signal.SIGKILL
        assert bench.dark(), (light, after_ms)
        found = bench.kept()
        # Only an image in progress is lost.
        assert found is None or found >= kept
        kept = found or kept
    assert kept > len(moments)
    bench.completed(MANY)


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGSEGV])
def test_a_signal_ends_a_scan_in_the_dark(bench, ending):
    program = bench.start(bench.plan(count=MANY))
    bench.wait(program, 3)
    program.send_signal(ending)
    _, errors = program.communicate(timeout=20)
    assert program.returncode == (130 if ending == signal.SIGINT else -ending), errors
    assert "Traceback" not in errors
    assert bench.dark()
    assert (bench.kept() or 0) >= 1
    bench.completed(MANY)


PHASES: dict[str, Callable[[Bench], bool]] = {
    "homing": lambda bench: bench.moving(),
    "exposures": lambda bench: bench.lit(),
    "moving": lambda bench: bench.camera.lit >= 2 and bench.moving(),
    "exposing": lambda bench: bench.camera.lit >= 2 and bench.lit(),
    "checking": lambda bench: bench.going_back(),
}
"""Phases of a scan, and how each is detected from outside."""
FAULTS = {
    "camera": "check power and cable",
    "stage": "gone|connection|lost",
    "alarm": "ALARM:1",
    "mute": "hangs|does not answer",
    "restart": "restarted by itself",
    "break-laser": "no laser light|the laser has failed|shows no stripe",
}
"""Faults, and the words of the message."""


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("phase", PHASES)
def test_hardware_that_fails_in_any_phase_ends_the_scan_in_the_dark(bench, phase, fault):
    laser_ms = '"auto"' if phase == "exposures" else "0.4"

    def fail() -> None:
        assert within(20.0, lambda: PHASES[phase](bench))
        match fault:
            case "camera":
                bench.camera.disconnect()
            case "stage":
                bench.controller.disconnect()
            case _:
                bench.controller.inject(fault)

    words = bench.words(bench.plan(laser_ms=laser_ms))
    failing = threading.Thread(target=fail)
    failing.start()
    done = uwlts(*words)
    failing.join()
    errors = [line for line in done.stderr.splitlines() if line.strip()]
    assert done.returncode == 2 and re.search(FAULTS[fault], errors[-1]), done.stderr
    if fault in ("mute", "break-laser"):
        bench.controller.inject(fault, 0)
    assert bench.dark()
    assert not bench.out.exists()
    kept = bench.kept() or 0
    assert kept >= {"homing": 0, "exposures": 0, "moving": 1, "exposing": 1, "checking": COUNT}[phase]
    if fault == "camera":
        bench.camera.connect()
    elif fault == "stage":
        bench.new_controller()
    bench.completed(laser_ms=laser_ms)


def test_a_disk_that_is_full_costs_the_image_at_hand(bench):
    program = bench.start(bench.plan(), largest_file=400_000)
    _, errors = program.communicate(timeout=60)
    assert program.returncode == 2 and "Traceback" not in errors, errors
    assert re.search("full|large", errors), errors
    assert bench.dark() and not bench.out.exists()
    assert bench.kept()
    bench.completed()


def test_a_folder_that_goes_away_ends_the_scan(bench, tmp_path):
    bench.out = tmp_path / "stick" / "scan.h5"
    bench.out.parent.mkdir()
    program = bench.start(bench.plan(count=MANY))
    bench.wait(program, 2)
    shutil.rmtree(bench.out.parent)
    _, errors = program.communicate(timeout=60)
    assert program.returncode == 2 and "Traceback" not in errors and str(bench.out.parent) in errors, errors
    assert bench.dark()


def test_hardware_and_capture_belong_to_one_scan(bench):
    plan = bench.plan(count=MANY)
    program = bench.start(plan)
    bench.wait(program, 2)
    for out in (bench.out, bench.folder / "other.h5"):
        second = uwlts("scan", plan, "--out", out, "--home")
        assert second.returncode == 2 and "Traceback" not in second.stderr, second.stderr
    _, errors = program.communicate(timeout=60)
    assert program.returncode == 0, errors
    bench.completed(MANY)
