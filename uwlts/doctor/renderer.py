"""Whether the twin, if it is installed, can render on this machine."""

import shlex
import subprocess
import sys
from importlib.util import find_spec

from uwlts.doctor.finding import Finding

_RENDERER_S = 330


def examine_renderer() -> list[Finding]:
    """Whether the twin's renderer finds a libLLVM and can run a kernel with it; the twin is asked, as a program."""
    subject = "libLLVM"
    if find_spec("twin") is None:
        return [Finding(subject, "ok", "not needed: the twin is not installed")]
    command = [sys.executable, "-m", "twin.llvm"]
    try:
        asked = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_RENDERER_S)
    except subprocess.TimeoutExpired:
        return [Finding(subject, "warning", f"no answer within {_RENDERER_S} s", f"try: {shlex.join(command)}")]
    chosen = [line.removeprefix("chosen: ") for line in asked.stdout.splitlines() if line.startswith("chosen: ")]
    if asked.returncode == 0 and chosen:
        return [Finding(subject, "ok", f"{chosen[0]}; a trial kernel ran")]
    said = asked.stderr.strip().splitlines() or [f"it ended with status {asked.returncode}"]
    # An own error says most in its first line, a traceback in its last.
    reason = said[0].removeprefix("error: ") if said[0].startswith("error: ") else said[-1]
    advice = f"only for rendering by the twin:\n{shlex.join(command)} --install"
    return [Finding(subject, "warning", f"the twin cannot render: {reason}", advice)]
