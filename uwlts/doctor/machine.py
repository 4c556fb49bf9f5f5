"""Findings about this machine: folder, network buffer, processors, memory, clock and renderer, and their table."""

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from rich import box
from rich.table import Table
from rich.text import Text

Status = Literal["ok", "optional", "warning", "missing"]

_STYLES = {"ok": "green", "optional": "dim", "warning": "yellow", "missing": "bold red"}


@dataclass(frozen=True)
class Finding:
    """Result of one examination.

    ``status`` is "missing" if something required, or named by the user, is absent or does not work, and "warning" if
    some features are limited. "optional" is absent, and only some features need it. All three come with ``advice``, one
    action per line.
    """

    subject: str
    status: Status
    found: str
    advice: str = ""

    @classmethod
    def from_advice(cls, subject: str, found: str, advice: str) -> "Finding":
        """Return a warning if there is advice, else ok."""
        return cls(subject, "warning" if advice else "ok", found, advice)


FRAME_BYTES = 1280 * 1024
"""Size of an 8-bit frame of the thesis's camera, bytes."""
FRAMES_PER_S = 60
"""Frame rate that the disk has to sustain, 1/s."""
_TRIAL_BYTES = 64_000_000  # a second of frames, beyond the cache of a disk's controller
# 7500 profiles: the bench's travel of 750 mm in steps of 0.1 mm, uncompressed.
_SCAN_BYTES = 7500 * FRAME_BYTES
_RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
_RECOMMENDED_BUFFER = 33_554_432
_LEAST_PROCESSORS = 2
_LEAST_MEMORY = 4e9
"""Least memory, bytes."""


def examine(folder: Path) -> list[Finding]:
    """Examine folder, network buffer, processors, memory and clock."""
    return [examine_folder(folder), examine_buffer(), examine_computer(), examine_clock()]


def examine_folder(folder: Path) -> Finding:
    """Examine whether captures can be written to a folder fast enough, by writing 64 MB, which are always removed."""
    path = folder.resolve()
    try:
        free = shutil.disk_usage(folder).free
        if free < 2 * _TRIAL_BYTES:
            return Finding("folder", "warning", f"the disk of {path} is full: {free / 1e6:.0f} MB free", "make room")
        rate = _writing_rate(folder)
    except OSError as error:
        advice = "work in a folder that you may write to, on a local disk"
        return Finding("folder", "warning", f"{path} cannot be written to: {error.strerror}", advice)
    minutes = free / (FRAME_BYTES * FRAMES_PER_S) / 60
    found = (
        f"{path} takes {rate / FRAME_BYTES:.0f} frames/s of 1280 x 1024 px ({rate / 1e6:.0f} MB/s), has room for "
        f"{free / 1e9:.0f} GB, {minutes:.0f} min at {FRAMES_PER_S} frames/s"
    )
    advice = f"make room: a long scan takes {_SCAN_BYTES / 1e9:.0f} GB" if free < _SCAN_BYTES else ""
    if rate < FRAME_BYTES * FRAMES_PER_S:
        advice = f"for {FRAMES_PER_S} frames/s use a faster disk, end what else writes to it, or read out a region"
    return Finding.from_advice("folder", found, advice)


def _writing_rate(folder: Path) -> float:
    """Return the rate of writing to the disk in bytes/s, measured with noise, which file systems cannot compress."""
    frame = os.urandom(FRAME_BYTES)
    frames = -(-_TRIAL_BYTES // FRAME_BYTES)
    # Without a name if the system supports it: the kernel removes it even after a kill.
    with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
        began = time.perf_counter()
        for _ in range(frames):
            written = 0
            while written < FRAME_BYTES:
                written += file.write(frame[written:])
        os.fsync(file.fileno())
        return frames * FRAME_BYTES / (time.perf_counter() - began)


def examine_buffer(limit: Path = _RMEM_MAX) -> Finding:
    """Examine whether the network buffer can hold a frame of a GigE camera while the program is busy."""
    try:
        allowed = int(limit.read_text())
    except (OSError, ValueError) as error:
        found, advice = f"{limit} cannot be read: {error}", "only for GigE cameras: look at its docs"
        return Finding("network buffer", "warning", found, advice)
    found = f"net.core.rmem_max is {allowed} bytes, {allowed / FRAME_BYTES:.1f} frames of 1280 x 1024 px"
    advice = (
        "only for GigE cameras, which lose packets otherwise:\n"
        f"sudo sysctl -w net.core.rmem_max={_RECOMMENDED_BUFFER}\n"
        f"echo net.core.rmem_max={_RECOMMENDED_BUFFER} | sudo tee /etc/sysctl.d/60-gige-camera.conf"
    )
    return Finding.from_advice("network buffer", found, "" if allowed >= FRAME_BYTES else advice)


def examine_computer() -> Finding:
    """Examine the processors that this program may use, and the memory."""
    from uwlts.runtime.workers import count_processors

    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    load = os.getloadavg()[0]
    found = (
        f"{count_processors()} processors, {load:.1f} of them busy in the last minute, {memory / 1e9:.0f} GB of memory"
    )
    enough = count_processors() >= _LEAST_PROCESSORS and memory >= _LEAST_MEMORY
    advice = f"take a computer of {_LEAST_PROCESSORS} processors and {_LEAST_MEMORY / 1e9:.0f} GB or more"
    return Finding.from_advice("computer", found, "" if enough else advice)


def examine_clock(files: Path | None = None) -> Finding:
    """Examine whether the clock is behind the newest file of a folder, by default that of this software.

    Small computers without a battery start with a date in the past, which captures would record.
    """
    folder = Path(__file__).parents[1] if files is None else files
    newest = max(path.stat().st_mtime for path in folder.rglob("*") if path.is_file())
    now = time.time()
    found = f"{_date(now)} UTC"
    if now >= newest - 1:
        return Finding("clock", "ok", found)
    found += f", before the date of files in {folder}, {_date(newest)} UTC"
    return Finding("clock", "warning", found, "set the clock: sudo timedatectl set-ntp true")


def _date(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M")


_RENDERER_S = 330  # above the time that the program itself gives its trial


def examine_renderer() -> list[Finding]:
    """Examine whether the twin finds a libLLVM and can run a kernel with it; the twin is run as a separate program."""
    if find_spec("twin") is None:
        return [Finding("libLLVM", "ok", "not needed: the twin is not installed")]
    command = [sys.executable, "-m", "twin.backend.llvm"]
    try:
        asked = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_RENDERER_S)
    except subprocess.TimeoutExpired:
        return [Finding("libLLVM", "warning", f"no answer within {_RENDERER_S} s", f"try: {shlex.join(command)}")]
    chosen = [line.removeprefix("chosen: ") for line in asked.stdout.splitlines() if line.startswith("chosen: ")]
    if asked.returncode == 0 and chosen:
        return [Finding("libLLVM", "ok", f"{chosen[0]}; a trial kernel ran")]
    said = asked.stderr.strip().splitlines() or [f"it ended with status {asked.returncode}"]
    # The program's own errors are most specific in the first line, tracebacks in the last.
    reason = said[0].removeprefix("error: ") if said[0].startswith("error: ") else said[-1]
    advice = f"only for rendering by the twin; how to install it says\n{shlex.join(command)}"
    return [Finding("libLLVM", "warning", f"the twin cannot render: {reason}", advice)]


def print_findings(findings: Sequence[Finding]) -> None:
    """Print a table of the findings, followed by the advice in lines that can be copied."""
    from uwlts.runtime.console import table_console

    console = table_console()
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("", "examined", "found"):
        table.add_column(heading, no_wrap=heading == "", overflow="fold")
    for each in findings:
        # Text objects, so that names from files are not interpreted as markup.
        table.add_row(Text(each.status, _STYLES[each.status]), Text(each.subject), Text(each.found))
    console.print(table)
    advised = [each for each in findings if each.advice]
    if advised:
        console.print("what to do", style="bold")
    for each in advised:
        lines = "".join(f"\n      {line}" for line in each.advice.splitlines())
        # Not wrapped, so that commands can be copied.
        console.print(Text(f"  {each.subject}:{lines}"), soft_wrap=True)
    missing = [each.subject for each in findings if each.status == "missing"]
    warnings = sum(each.status == "warning" for each in findings)
    said = f"missing: {', '.join(missing)}" if missing else "nothing that is required is missing"
    console.print(Text(f"{said}; {warnings} warning{'' if warnings == 1 else 's'}"), soft_wrap=True)
