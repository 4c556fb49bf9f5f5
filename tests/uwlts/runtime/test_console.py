"""Entry of the commands: signals."""

import signal
import subprocess
import sys
import time

_PROGRAM = """
import sys, time
from cyclopts import App
from uwlts.runtime.console import run
app = App()

@app.command
def wait():
    print("begun", flush=True)
    time.sleep(60)

sys.argv = ["x", "wait"]
sys.exit(run(app))
"""


def test_a_command_that_was_started_with_interrupts_ignored_ends_by_one():
    """As a shell starts a script's background commands."""
    with subprocess.Popen(
        [sys.executable, "-c", _PROGRAM],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    assert (process.returncode, time.monotonic() - begun < 20) == (130, True)
    assert said.startswith("interrupted")
