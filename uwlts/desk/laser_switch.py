"""Program's side of Laser off: the page's button, and the process that obeys it independently of the page's server.

Anyone who can reach the page can keep its server busy. Therefore the button sends its request to both
`uwlts.desk.laser_listener`, at its own port, and the page's server. A press that arrives twice is obeyed once.
"""

import json
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from nicegui import ui

from uwlts.desk.access import PageAccess
from uwlts.desk.laser_listener import MESSAGE_BYTES, PRESS
from uwlts.desk.shown_state import Board
from uwlts.errors import HardwareError, SetupError
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.rig import LaserStage

_BUTTON = Path(__file__).with_name("laser_off.html")
_START_S, _ANSWER_S, _END_S = 30.0, 5.0, 3.0
_REMEMBERED = 100
"""Presses that are remembered to recognise their second arrival, at most some seconds later."""


class LaserSwitch:
    """Calls ``switch_off`` at every press of Laser off, and at the key Escape while the laser is ``in_use``.

    ``switch_off`` must be thread-safe. Errors are reported on the board.
    """

    def __init__(self, board: Board, switch_off: Callable[[], None], *, in_use: Callable[[], bool] = lambda: True):
        self._board, self._switch_off, self._in_use = board, switch_off, in_use
        self._obeyed: deque[str] = deque(maxlen=_REMEMBERED)
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None

    def serve(self, access: PageAccess, listening: socket.socket, *, page_port: int) -> None:
        """Start the process with a socket, which it takes over; raises SetupError if it does not start."""
        self.port = listening.getsockname()[1]
        self._lending, lending = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._presses, presses = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with listening, lending, presses:
            given = [each.fileno() for each in (listening, lending, presses)]
            # In a separate session, the terminal's Ctrl-C and Ctrl-Z and signals to the process group do not reach it.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "uwlts.desk.laser_listener", *map(str, given)],
                pass_fds=given,
                start_new_session=True,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
        rules = json.dumps({"access": asdict(access), "page_port": page_port})
        if not self._ask(rules.encode(), [], _START_S):
            self.close()
            raise SetupError("the process that listens for Laser off did not start")
        self._thread = threading.Thread(target=self._listen, name="laser off", daemon=True)
        self._thread.start()

    def _ask(self, message: bytes, descriptors: list[int], wait_s: float) -> bool:
        """Send a message, and return whether the process answers."""
        self._lending.settimeout(wait_s)
        try:
            if descriptors:
                socket.send_fds(self._lending, [message], descriptors)
            else:
                self._lending.send(message)
            return bool(self._lending.recv(MESSAGE_BYTES))
        except OSError:
            return False

    def _listen(self) -> None:
        with suppress(OSError):
            while name := self._presses.recv(MESSAGE_BYTES):
                self.press(name.decode())
                # Without this answer the process repeats Ctrl-X, also if `press` has failed.
                self._presses.send(name)
        if self._process is not None:
            self._board.say("the process that listens for Laser off has ended: restart this program", "error")

    def lend(self, stage: LaserStage | None) -> None:
        """Lend the process the port of a stage to switch its laser off; None takes the port back.

        Raises HardwareError if the process has ended or is suspended.
        """
        if self._process is None:
            return
        lent = [stage.descriptor] if isinstance(stage, GrblStage) else []
        if self._ask(b"port" if lent else b"none", lent, _ANSWER_S):
            return
        # It must not keep the port, which is free when the process has ended.
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        if lent:
            raise HardwareError(
                "the process that listens for Laser off has ended or is suspended: restart this program"
            )

    def press(self, name: object) -> None:
        """Obey a press at its first arrival; other values are ignored."""
        if not isinstance(name, str) or not PRESS.fullmatch(name):
            return
        # The second arrival waits until the press is obeyed.
        with self._lock:
            if name in self._obeyed:
                return
            self._obeyed.append(name)
            if name.startswith("off") or self._in_use():
                self._switch_off()

    def show_button(self) -> None:
        """Add the button to a page; it precedes the page's scripts, and is displayed above everything else."""
        ui.add_body_html(_BUTTON.read_text(encoding="utf-8").replace("LISTENER_PORT", str(self.port)))
        ui.on("laser_off", lambda event: self.press(event.args))

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is None:
            return
        # Wakes the thread.
        self._presses.shutdown(socket.SHUT_RDWR)
        if self._thread is not None:
            self._thread.join(_END_S)
        self._presses.close()
        self._lending.close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
