"""Switches the laser off when the program that lit it is gone: killed, crashed, or ended without closing the port.

A process of its own, started by `GrblLine` with the open port and, as standard input, a pipe whose writing end only
that program has. When the program ends, however it does, the pipe ends; the guard then sends Ctrl-X, on which Grbl
switches its spindle pin off at once, and closes the port. It runs as a plain script so that it starts within
milliseconds and needs nothing but the standard library.
"""

import os
import select
import sys
import termios
import time

_SOFT_RESET = b"\x18"
_WATCH_S, _GIVE_UP_S = 0.2, 2.0


def wait_for_the_end_of(parent: int) -> None:
    """Return when standard input ends, or when the process ``parent`` is no longer this one's parent.

    The second way is for a pipe that a forked child of the program keeps open.
    """
    while os.getppid() == parent:
        if select.select([sys.stdin], [], [], _WATCH_S)[0]:
            return


def switch_off(port: int) -> None:
    """Send the reset and see it out of the computer; a port that is gone has no laser to switch off."""
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


if __name__ == "__main__":
    wait_for_the_end_of(int(sys.argv[1]))
    switch_off(int(sys.argv[2]))
