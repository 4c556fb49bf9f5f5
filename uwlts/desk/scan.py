"""A single scan, optionally with the page of `uwlts watch`."""

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
from uwlts.files.writing import refuse_unsuitable
from uwlts.hardware.continuous import ScanListeners
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scan_plan import ScanPlan, load_plan
from uwlts.hardware.scanning import ScanProgress, open_camera, record_scan
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import CAPTURES

_POLITE = 10
"""Reduction of the page's priority in favour of the recording, as by ``nice``."""
_PATIENCE_S = 5.0  # for a process to end
_SIGNAL_WHEN_PARENT_ENDS = 1
"""PR_SET_PDEATHSIG of Linux's prctl."""


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
    progress: ProgressListener = ignore_progress,
    report: Callable[[str], None] = lambda line: None,
    warn: Callable[[str], None] = lambda text: None,
) -> ScanProgress:
    """Record a scan with a camera and a stage into a capture.

    For each image: move, let the stage settle, switch the laser, take the image, and store it with the position read
    back. The plan is checked against travel and volume before anything moves. The laser goes off however the scan ends.
    An interrupted scan leaves its complete images in ``out.part``; ``resume`` continues with the exposures of the
    recorded images.

    Parameters
    ----------
    plan : ScanPlan or path of a TOML file
        TOML file with sensor, medium, positions, lights and exposures (docs: scan).
    out : str or Path
        Capture to write.
    camera : str, optional
        Address of the camera, instead of the plan's: gige:NAME or replay:PATH.
    stage : str, optional
        Serial port of the stage, instead of the plan's.
    home : bool
        Home the stage first.
    unlock : bool
        Accept the stage's position without homing.
    watch : bool
        Show the recording in a browser, as uwlts watch does.
    calibration : str or Path, optional
        Watched: calibration of the sensor, or polynomial calibration, for the cloud.
    port : int
        Watched: port of the page; if it is in use, the next free one is taken.
    resume : bool
        Continue an interrupted scan; refused if the plan differs from that of the interrupted scan.
    overwrite : bool
        Replace an existing capture.
    progress : callable, optional
        Called with the number of finished images and the total.
    report, warn : callable, optional
        Called with lines of text about the scan, and with warnings.

    Returns
    -------
    ScanProgress
        Counts of profile lines and of faulty images, and the latest exposures.

    Raises
    ------
    DescriptionError
        Camera or stage are not named; sensor, medium, target or artefact are not valid.
    RangeError, DesignError
        The plan cannot be carried out; nothing has moved.
    HardwareError
        Camera, stage or laser fail, or the camera's image size differs from the sensor's description. Also raised at
        the end of a scan whose stage has lost steps: all images are in ``out.part``, and ``resume`` accepts them.
    OutputError
        The file exists, or cannot be written.
    """
    refuse_unsuitable(Path(out), overwrite=overwrite, endings=CAPTURES)
    plan, out = plan if isinstance(plan, ScanPlan) else load_plan(Path(plan)), Path(out)
    address, serial_port = plan.devices(camera=camera, stage=stage)
    if calibration:
        if not watch:
            raise DescriptionError("`calibration` is for the cloud on the page: give `watch` too")
        load_calibration(calibration)
    with ExitStack() as stack:
        page = stack.enter_context(WatchPage(out, calibration=calibration, port=port, say=report)) if watch else None
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
            listeners=ScanListeners(
                progress, report, warn, recorded=lambda frame, number: None if page is None else page.start()
            ),
        )


class WatchPage:
    """Page that shows a recording from `start` until the ``with`` ends; its failures do not affect the recording.

    The page is a separate process, which can neither slow the recording nor end it. ``say`` is called, from another
    thread, with a line that states the page's address.
    """

    def __init__(self, capture: Path, *, calibration: str | Path | None, port: int, say: Callable[[str], None]):
        command = [sys.executable, "-m", "uwlts", "watch", str(capture), "--port", str(port)]
        self._command = [*command, "--calibration", str(calibration)] if calibration else command
        self._say = say
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Open the page after the recording has begun: before that, a file of its name would be an older one."""
        if self._process is not None:
            return
        library = ctypes.CDLL(None)
        # In a separate session, the terminal's Ctrl-C does not reach it. The kernel ends it if the scan is killed.
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
        # Further lines are read, so that the pipe does not fill up.
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
