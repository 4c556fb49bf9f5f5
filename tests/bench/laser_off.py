"""Time of laser light after faults: ``python -m tests.bench.laser_off [tries] [--write]``, 100 of each by default.

Runs with different ``--seed`` draw different times of the faults.

A program of its own takes laser images by `uwlts.hardware.rig` with the twin's camera and controller. Each fault occurs
while the laser is on and the camera's image is late, so that nothing but the protection ends the light. Light is the
state of the simulated controller's pin. Printed is the longest uninterrupted light after the fault, over all later
attempts at an image. The exit status is 1 if one is longer than the exposure + 1 s.
"""

import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from cyclopts import App

from docs.studies.result_tables import publish, table
from tests.system.drawn_hardware import STAGE, DrawnCamera, write_plan
from tests.waiting import within
from twin.devices.grbl_controller import GrblController

EXPOSURE_MS = 0.09
LIMIT_S = 1e-3 * EXPOSURE_MS + 1.0
LATE_S = 5.0
"""Delay of late images: longer than the program waits for one."""
OBSERVED_S = 12.0
"""Longer than three attempts at an image."""
KILLED_S = 2.0
"""Observation after both processes have ended or been suspended: twice the limit."""

PROGRAM = f"""
import sys
from pathlib import Path
from uwlts.errors import HardwareError
from uwlts.hardware.scanning import open_camera
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.rig import Rig
from uwlts.hardware.scan_plan import load_plan

plan = load_plan(Path(sys.argv[1]))
try:
    with GrblStage(plan.stage.port) as stage, open_camera(plan.camera) as camera:
        rig = Rig(plan, plan.stage, plan.described_sensor(), camera, stage, ahead=1.0)
        rig.frame("laser", {EXPOSURE_MS})
        print(stage._guard.pid, flush=True)
        sys.stdin.readline()
        while True:
            rig.frame("laser", {EXPOSURE_MS})
except HardwareError as error:
    sys.exit(str(error))
"""


class Taking:
    """A program that takes laser images, its guard's process, camera and controller."""

    def __init__(self, camera: DrawnCamera, controller: GrblController, program: "subprocess.Popen[str]", guard: int):
        self.camera, self.controller, self.program, self.guard = camera, controller, program, guard

    def signal_both(self, number: signal.Signals) -> None:
        """Send a signal to program and guard at once."""
        os.kill(self.guard, number)
        self.program.send_signal(number)

    def signal_program(self, number: signal.Signals) -> None:
        """Send a signal to the program only."""
        self.program.send_signal(number)


Fault = Callable[[Taking], None]
FAULTS: dict[str, tuple[Fault, float]] = {
    "program and guard killed": (lambda run: run.signal_both(signal.SIGKILL), KILLED_S),
    "program and guard suspended": (lambda run: run.signal_both(signal.SIGSTOP), KILLED_S),
    "program killed": (lambda run: run.signal_program(signal.SIGKILL), KILLED_S),
    "program suspended": (lambda run: run.signal_program(signal.SIGSTOP), KILLED_S),
    "camera delays its images": (lambda run: None, OBSERVED_S),
    "camera loses its images": (lambda run: run.camera.inject("drop", 3), OBSERVED_S),
    "camera unplugged": (lambda run: run.camera.disconnect(), OBSERVED_S),
    "controller mute": (lambda run: run.controller.inject("mute"), OBSERVED_S),
    "controller's line cut": (lambda run: run.controller.inject("cut-line"), OBSERVED_S),
}
"""Faults with the longest time of observation, which ends earlier with the program."""


def measure_light(name: str, folder: Path, *, wait_s: float) -> float:
    """Cause a fault ``wait_s`` after the laser was switched on; return the longest light after the fault in s."""
    cause, observed_s = FAULTS[name]
    with GrblController(settings=STAGE | {20: 0, 22: 0}, boot_s=0.1) as controller, DrawnCamera(controller) as camera:
        plan = write_plan(folder, camera, controller, count=1, step_mm=1.0, laser_ms=str(EXPOSURE_MS))
        program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, plan],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert program.stdin is not None and program.stdout is not None
        guard = 0
        try:
            guard = int(program.stdout.readline() or program.communicate()[1])
            run = Taking(camera, controller, program, guard)
            if "loses" not in name:
                camera.inject("delay", 3, delay_s=LATE_S)
            program.stdin.write("\n")
            program.stdin.flush()
            while not controller.state().laser_on:
                assert program.poll() is None
                time.sleep(0.0005)
            time.sleep(wait_s)
            fault_s = time.monotonic()
            cause(run)
            within(observed_s, lambda: program.poll() is not None)
            if "killed" in name:
                time.sleep(observed_s)
            ends_s = [(each.on_s, each.on_s + each.duration_s) for each in controller.lights]
            return max((end_s - max(on_s, fault_s) for on_s, end_s in ends_s if end_s > fault_s), default=0.0)
        finally:
            program.kill()
            program.communicate()
            if guard:
                with suppress(ProcessLookupError):
                    os.kill(guard, signal.SIGKILL)


def main(tries: int = 100, *, seed: int = 0, write: bool = False) -> int:
    """Cause each fault a number of times, at different times of the light; print the table or write it to its page."""
    chosen, measured = random.Random(seed), {name: [] for name in FAULTS}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(tries):
            for name, found in measured.items():
                found.append(measure_light(name, Path(folder), wait_s=chosen.uniform(0.0, 0.2)))
                print(f"{name}: {found[-1]:.3f} s", file=sys.stderr, flush=True)
    rows = [[name, f"{statistics.median(found):.2f}", f"{max(found):.2f}"] for name, found in measured.items()]
    head = ["fault", "median, s", f"longest, s (limit {LIMIT_S:.2f})"]
    publish({"light after faults": table(head, rows)}, write=write)
    return int(any(each > LIMIT_S for found in measured.values() for each in found))


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
