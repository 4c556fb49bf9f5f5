"""Switches the laser off when the program that lit it makes no progress any more, or is gone.

A process of its own, started by `uwlts.hardware.heartbeat` with the open port. The program writes beats to its standard
input: until when the laser may stay on without a further beat. Each is answered on its standard output. When a beat is
late, as the program is suspended or hangs, the guard sends Ctrl-X, on which Grbl switches its spindle pin off at once;
so it does when its standard input ends, which it does however the program ends, and when it is asked to end itself. It
runs as a plain script so that it starts within milliseconds and needs nothing but the standard library.
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
"""Until when the laser may stay on, by the monotonic clock, which all processes share; inf while it is off."""
WATCHING, SWITCHED_OFF = b"w", b"o"
"""Answers to a beat: in time; or the laser was switched off since the last beat that said that it is off."""
_SOFT_RESET = b"\x18"
_WATCH_S, _GIVE_UP_S = 0.2, 2.0
_AGAIN_S = 0.5
"""After a late beat the reset is repeated, as the program may be continued just before a line that lights the laser."""


def watch(parent: int, port: int) -> None:
    """Answer beats until standard input ends, or the process ``parent`` is no longer this one's parent.

    The second way is for a pipe that a forked child of the program keeps open.
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
    """Send the reset and see it out of the computer; a port that is gone has no laser to switch off."""
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
