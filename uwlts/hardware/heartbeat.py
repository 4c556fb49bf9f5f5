"""Program's side of the laser guard: starts its process and sends the times until which the laser may stay on.

The thread that works with camera and stage sends the beats, between the calls of their drivers. A thread that only
sends beats would continue while a driver hangs.
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
"""A program without progress for this long, beyond announced waits, counts as hung. The laser must be off within 1 s,
and the guard needs a few ms to wake up and send."""
BEAT_S = 0.1  # longest time between two beats in a waiting loop
_ANSWER_S = 0.5  # time limit of the guard's answer, which takes less than 1 ms unless the guard is suspended
_END_S = 3.0  # for the guarding process to end

GuardState = Literal["watching", "switched off", "gone"]
"""Answer to a beat. "switched off": a beat was late and the guard has switched the laser off; "gone": the guard does
not answer."""


class Heartbeat:
    """Process of the laser guard, which shares the open serial port ``descriptor``; ``pid`` is its identifier.

    Raises HardwareError if the guard cannot be started.
    """

    def __init__(self, descriptor: int):
        try:
            # In a separate session, the terminal's Ctrl-C and Ctrl-Z and signals to the process group do not reach it.
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
        """Allow the laser to stay on for ``allowed_s`` without a further beat; inf means that the laser is off."""
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
            # A later answer would be mistaken for that to another beat.
            self._gone = True
        return "gone"

    def end(self) -> None:
        """End the guard process, which switches the laser off."""
        for pipe in (self._guard.stdin, self._guard.stdout):
            if pipe is not None:
                pipe.close()
        self._gone = True
        try:
            self._guard.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._guard.kill()
            self._guard.wait()
