"""The program's side of the laser guard: starts its process and tells it how long the laser may stay on.

Beats are sent by the thread that works with the camera and the stage, between two calls of their drivers. A thread of
their own would go on beating while a driver hangs.
"""

import math
import os
import select
import subprocess
import sys
import time
from typing import Literal

from uwlts.errors import HardwareError
from uwlts.hardware import laser_guard

GRACE_S = 0.8
"""A program that makes no progress for this long, beyond the waits that it announces, is taken for hung. The laser has
to be off within 1 s; the guard needs some ms to wake and to send."""
BEAT_S = 0.1
"""Longest time between two beats of a loop that waits."""
_ANSWER_S = 0.5
"""The guard answers within a ms; one that is suspended does not."""
_END_S = 3.0

GuardState = Literal["watching", "switched off", "gone"]
"""Answer to a beat. "switched off": a beat was late and the guard has switched the laser off; "gone": the guard does
not answer."""


class Heartbeat:
    """A guard that has the open serial port ``descriptor``; HardwareError where it cannot be started.

    ``pid`` is its process.
    """

    def __init__(self, descriptor: int):
        try:
            # In a session of its own neither the terminal's Ctrl-C and Ctrl-Z nor signals to the group reach it.
            self._guard = subprocess.Popen(
                [sys.executable, "-I", "-S", laser_guard.__file__, str(os.getpid()), str(descriptor)],
                pass_fds=(descriptor,),
                start_new_session=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                bufsize=0,
            )
        except OSError as error:
            raise HardwareError(f"cannot start the guard that switches the laser off: {error.strerror}") from error
        self.pid = self._guard.pid
        self._gone = False

    def beat(self, allowed_s: float) -> GuardState:
        """Allow the laser to stay on for so long from now without a further beat; inf says that it is off."""
        wants, answers = self._guard.stdin, self._guard.stdout
        assert wants is not None and answers is not None
        if not self._gone:
            deadline = time.monotonic() + allowed_s if allowed_s < math.inf else math.inf
            try:
                os.write(wants.fileno(), laser_guard.BEAT.pack(deadline))
                answered = select.select([answers], [], [], _ANSWER_S)[0]
                answer = os.read(answers.fileno(), 1) if answered else b""
            except (OSError, ValueError):
                answer = b""
            if answer:
                return "switched off" if answer == laser_guard.SWITCHED_OFF else "watching"
            # An answer that comes later would be taken for that to another beat.
            self._gone = True
        return "gone"

    def end(self) -> None:
        """End the guard, which switches the laser off."""
        for pipe in (self._guard.stdin, self._guard.stdout):
            if pipe is not None:
                pipe.close()
        self._gone = True
        try:
            self._guard.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._guard.kill()
            self._guard.wait()
