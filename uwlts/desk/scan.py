"""A scan on its own, with the page of `uwlts watch` beside it where that is wanted."""

import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from uwlts.errors import DescriptionError
from uwlts.files.inputs import inputs_kept
from uwlts.files.writing import refuse_unsuitable
from uwlts.hardware.camera_addresses import open_camera
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scan_plan import ScanPlan, load_plan
from uwlts.hardware.scanning import ScanProgress, record_scan
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import CAPTURES

_POLITE = 10
"""Priority given up in favour of the recording, as by ``nice``."""
_PATIENCE_S = 5.0
_SIGNAL_WHEN_PARENT_ENDS = 1
"""PR_SET_PDEATHSIG of Linux's prctl."""


@inputs_kept()
def scan(
    plan: str | Path | ScanPlan,
    out: str | Path,
    *,
    camera: str | None = None,
    stage: str | None = None,
    home: bool = False,
    unlock: bool = False,
    watch: bool = False,
    calibration: str | Path | None = None,
    port: int = 8080,
    resume: bool = False,
    overwrite: bool = False,
    progress: ProgressListener = unheard,
    report: Callable[[str], None] = lambda line: None,
    warn: Callable[[str], None] = lambda text: None,
) -> ScanProgress:
    """Record a scan with a camera and a stage into a capture.

    Moves, lets the stage settle, switches the laser, takes an image and stores it with the position read back.

    The plan is checked against travel and volume before anything moves; the laser goes off however the scan ends. An
    interrupted scan leaves its complete images in ``out.part``; ``resume`` goes on after them, at exposures that the
    recorded images have.

    Parameters
    ----------
    plan : ScanPlan or path of a TOML file
        TOML file with sensor, medium, positions, lights and exposures (docs/how-to/scan.md).
    out : str or Path
        Capture to write.
    camera : str, optional
        Address of the camera, in place of the plan's: gige:NAME, genicam:PRODUCER.cti or replay:PATH.
    stage : str, optional
        Serial port of the stage, in place of the plan's.
    home : bool
        Find the limit switch first.
    unlock : bool
        Take the stage's position as it is, without homing.
    watch : bool
        Show the recording in a browser meanwhile, as uwlts watch does.
    calibration : str or Path, optional
        Watched: calibration of the sensor, or one by polynomials, for the cloud.
    port : int
        Watched: port of the page; the next free one is taken if it is in use.
    resume : bool
        Continue an interrupted scan; refused if the plan is another than the one it began with.
    overwrite : bool
        Replace an existing capture.
    progress : callable, optional
        Called with the number of images done and the number in all.
    report, warn : callable, optional
        Called with lines of text about the scan, and about what needs attention.

    Raises
    ------
    DescriptionError
        Camera or stage are not named; sensor, medium, target or artefact are not valid.
    RangeError, DesignError
        The plan cannot be carried out; nothing has moved.
    HardwareError
        Camera, stage or laser fail, or the camera has another image size than the sensor's description. Or the stage
        has lost steps, which is seen at the end: all images are in ``out.part`` then, and ``resume`` takes them as they
        are.
    OutputError
        The file exists, or cannot be written.
    """
    refuse_unsuitable(Path(out), overwrite=overwrite, endings=CAPTURES)
    plan, out = plan if isinstance(plan, ScanPlan) else load_plan(Path(plan)), Path(out)
    address, serial_port = camera or plan.camera, stage or plan.stage.port
    if address is None or serial_port is None:
        what = "camera" if address is None else "stage"
        raise DescriptionError(f"the plan names no {what}: give `{what}`")
    if calibration:
        if not watch:
            raise DescriptionError("`calibration` is for the cloud on the page: give `watch` too")
        load_calibration(calibration)
    with ExitStack() as stack:
        page = stack.enter_context(PageBeside(out, calibration=calibration, port=port, say=report)) if watch else None
        moved, opened = stack.enter_context(GrblStage(serial_port)), stack.enter_context(open_camera(address))
        if home:
            report("homing")
            moved.home()
        elif unlock:
            moved.unlock()
        return record_scan(
            plan,
            out,
            camera=opened,
            stage=moved,
            resume=resume,
            overwrite=overwrite,
            progress=progress,
            report=report,
            warn=warn,
            recorded=lambda frame, number: None if page is None else page.start(),
        )


class PageBeside:
    """Shows a recording from `start` on until the ``with`` ends; what goes wrong with it is said and has no effect.

    The page is a process of its own: it can neither slow the recording nor end it.

    ``say`` is called with the line that states the page's address, from another thread.
    """

    def __init__(self, capture: Path, *, calibration: str | Path | None, port: int, say: Callable[[str], None]):
        command = [sys.executable, "-m", "uwlts", "watch", str(capture), "--port", str(port)]
        self._command = [*command, "--calibration", str(calibration)] if calibration else command
        self._say = say
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Open the page; once the recording has begun, for before a file of its name would be an older one."""
        if self._process is not None:
            return
        library = ctypes.CDLL(None)
        # In a session of its own the terminal's Ctrl-C does not reach it. It ends with a scan that is killed, too.
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=lambda: library.prctl(_SIGNAL_WHEN_PARENT_ENDS, signal.SIGTERM),
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, _POLITE)
        threading.Thread(target=self._announce, args=(self._process,), daemon=True).start()

    def _announce(self, process: "subprocess.Popen[str]") -> None:
        # What comes later must not fill the pipe.
        for line in process.stdout or ():
            if line.startswith("open "):
                self._say(f"{line.split(';')[0]}, while the scan runs")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
