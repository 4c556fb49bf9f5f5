"""The page of `uwlts watch` beside a scan, in a process of its own: it can neither slow the recording nor end it."""

import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Self

_POLITE = 10
"""Priority given up in favour of the recording, as by ``nice``."""
_PATIENCE_S = 5.0
_SIGNAL_WHEN_PARENT_ENDS = 1
"""PR_SET_PDEATHSIG of Linux's prctl."""


class PageBeside:
    """Shows a recording from `start` on until the ``with`` ends; what goes wrong with it is said and has no effect.

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
