"""Laser guard: a process that switches the laser off when the program that controls it hangs or has ended.

`uwlts.hardware.heartbeat` starts it with the open port. The program writes beats to the guard's standard input: the
time until which the laser may stay on without a further beat. The guard answers each on its standard output. If a beat
is late because the program is suspended or hangs, the guard sends Ctrl-X. Grbl then switches its spindle pin off at
once. The guard does the same when its standard input ends, as at any end of the program, and when it is asked to end
itself. It runs as a plain script with only the standard library, so that it starts within milliseconds.
"""

import math
import os
import select
import signal
import struct
import sys
import time

try:
    import termios
except ImportError:
    termios = None  # Windows, where no stage can be used

BEAT = struct.Struct("d")
"""Time until which the laser may stay on, by the monotonic clock that all processes share; inf while it is off."""
WATCHING, SWITCHED_OFF = b"w", b"o"
"""Answers to a beat: in time, or the guard has switched the laser off since the last beat with inf."""
_SOFT_RESET = b"\x18"
_WATCH_S, _GIVE_UP_S = 0.2, 2.0
_AGAIN_S = 0.5
"""Interval between resets after a late beat: the program may resume just before a laser command."""


def watch(parent: int, port: int) -> None:
    """Answer beats until standard input ends, or the process ``parent`` is no longer the parent of this one.

    The second condition is for a pipe that a forked child of the program keeps open.
    """
    deadline, late = math.inf, False
    while os.getppid() == parent:
        left_s = deadline - time.monotonic()
        if left_s <= 0:
            switch_off(port)
            deadline, late = time.monotonic() + _AGAIN_S, True
        elif select.select([0], [], [], min(left_s, _WATCH_S))[0]:
            beat = os.read(0, BEAT.size)
            if len(beat) < BEAT.size:
                return
            wanted = BEAT.unpack(beat)[0]
            # A program that was suspended before it wrote its beat is late, too.
            if late or wanted <= time.monotonic():
                switch_off(port)
                late = True
                deadline = time.monotonic() + _AGAIN_S
            else:
                deadline = wanted
            os.write(1, SWITCHED_OFF if late else WATCHING)
            if wanted == math.inf:
                deadline, late = math.inf, False


def switch_off(port: int) -> None:
    """Send the reset and wait until it is transmitted; if the port is gone, there is no laser to switch off."""
    assert termios is not None
    deadline = time.monotonic() + _GIVE_UP_S
    while time.monotonic() < deadline:
        try:
            os.write(port, _SOFT_RESET)
            termios.tcdrain(port)
            return
        except BlockingIOError:
            select.select([], [port], [], _WATCH_S)
        except (OSError, termios.error):
            return


def _end(*_: object) -> None:
    sys.exit()


if __name__ == "__main__":
    for _asked in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(_asked, _end)
    try:
        watch(int(sys.argv[1]), int(sys.argv[2]))
    except BrokenPipeError:
        pass
    finally:
        switch_off(int(sys.argv[2]))
