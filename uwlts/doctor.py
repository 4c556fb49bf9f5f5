"""Examination of this machine for rendering, calibration and scanning, with advice, and its table.

The stage is not moved and the laser stays off: a trial only sends queries, and Ctrl-X at the end, which switches the
laser's pin off. No files are left.
"""

import os
import platform
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from typing import Literal

from rich import box
from rich.table import Table
from rich.text import Text

from uwlts.errors import Error, HardwareError, SetupError
from uwlts.runtime.optional_library import ARAVIS_VARIABLE, EXTRAS, load_aravis, pip_install, read_requirements
from uwlts.runtime.progress import ProgressListener, ignore_progress

try:
    import grp
except ImportError:
    grp = None  # Windows, where ports have no owners

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


def examine(
    *, camera: str | None = None, stage: str | None = None, progress: ProgressListener = ignore_progress
) -> list[Finding]:
    """Examine libraries, renderer, cameras and serial ports of this machine, with advice.

    It takes about ten seconds.

    Parameters
    ----------
    camera
        Address of a camera to take ten frames: gige:NAME or replay:PATH. Its trigger
        is switched off, and its whole image is read out.
    stage
        Serial port of a stage, whose version, settings and state are read. It is not moved and the laser stays off, but
        an Arduino Uno restarts: home before the next scan.
    progress
        Called with the number of finished parts and the total.

    Returns
    -------
    list of Finding
        Subject, status, result and advice of each check.
    """
    parts: list[Callable[[], Sequence[Finding]]] = [examine_libraries, examine_renderer, examine_cameras, examine_ports]
    if camera is not None:
        parts.append(partial(try_camera, camera))
    if stage is not None:
        parts.append(partial(try_stage, stage))
    findings: list[Finding] = []
    for done, part in enumerate(parts):
        progress(done, len(parts))
        try:
            findings += part()
        except ImportError as error:
            found = f"a part was left out: {error}"
            findings.append(Finding("examination", "missing", found, "install again the library that failed"))
    progress(len(parts), len(parts))
    return findings


_ABSENT = "not installed"


def examine_libraries() -> list[Finding]:
    """Examine Python and all libraries; ImportError without the library packaging."""
    python, required, extras = read_requirements()
    return [examine_python(python), *examine_required(required), *examine_optional(extras)]


def examine_python(wanted: str) -> Finding:
    """Examine whether this Python has a version like ``wanted``, such as ">=3.11"."""
    from packaging.specifiers import SpecifierSet

    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {sys.executable}"
    if not SpecifierSet(wanted).contains(platform.python_version(), prereleases=True):
        return Finding("Python", "missing", f"{found}; needed is {wanted}", f"install Python {wanted}")
    advice = "" if sys.platform == "linux" else "use Linux for cameras and stage: nothing else has been tried"
    return Finding.from_advice("Python", found, advice)


def examine_required(requirements: Sequence[str]) -> list[Finding]:
    """Return one finding for all installed libraries in a suitable version, and one for every other."""
    examined = [(line, *_examine_requirement(line)) for line in requirements]
    good = ", ".join(f"{name} {version}" for _, name, version, fault in examined if not fault)
    findings = [Finding("required libraries", "ok", good)] if good else []
    return findings + [
        Finding(name, "missing", fault, pip_install([line])) for line, name, _, fault in examined if fault
    ]


def examine_optional(extras: Mapping[str, Sequence[str]], purposes: Mapping[str, str] = EXTRAS) -> list[Finding]:
    """Examine the libraries of each extra with a purpose; absent ones are optional, and others that fail a warning."""
    findings = []
    for extra, purpose in purposes.items():
        examined = [_examine_requirement(line) for line in extras[extra]]
        texts = ", ".join(f"{name} {fault or version}" for name, version, fault in examined)
        faults = {fault for _, _, fault in examined if fault}
        status = "ok" if not faults else "optional" if faults == {_ABSENT} else "warning"
        advice = f"only for {purpose}:\n{pip_install(extras[extra])}" if faults else ""
        findings.append(Finding(extra, status, f"{texts}; for {purpose}", advice))
    return findings


def _examine_requirement(line: str) -> tuple[str, str, str]:
    """Return a required library's name, its version, and its fault, or an empty text."""
    from packaging.requirements import Requirement

    wanted = Requirement(line)
    try:
        version = metadata.version(wanted.name)
    except metadata.PackageNotFoundError:
        return wanted.name, "", _ABSENT
    if wanted.specifier.contains(version, prereleases=True):
        return wanted.name, version, ""
    return wanted.name, version, f"{version} is installed, {wanted.specifier} is needed"


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
    lines = asked.stderr.strip().splitlines() or [f"it ended with status {asked.returncode}"]
    # The program's own errors are most specific in the first line, tracebacks in the last.
    reason = lines[0].removeprefix("error: ") if lines[0].startswith("error: ") else lines[-1]
    advice = f"only for rendering by the twin; how to install it says\n{shlex.join(command)}"
    return [Finding("libLLVM", "warning", f"the twin cannot render: {reason}", advice)]


# Aravis waits for answers for a second; drivers of faulty USB devices may hang.
_DISCOVERY_S = 2.5
_USUAL_GROUP = "dialout"
_JOIN_GROUP = "sudo usermod -aG {} $USER\nthen log out and in again"


def examine_cameras() -> list[Finding]:
    """Examine the library Aravis, and search for cameras for 2.5 s."""
    from uwlts.hardware.aravis import list_aravis_cameras

    try:
        library = load_aravis()
    except SetupError as error:
        fault, _, advice = str(error).partition("\nInstall it:")
        advice = "\n".join(line.strip() for line in advice.strip().splitlines())
        status = "warning" if os.environ.get(ARAVIS_VARIABLE) else "optional"
        return [Finding("Aravis", status, fault, f"only for GigE Vision and USB3 Vision cameras:\n{advice}")]
    findings = [Finding("Aravis", "ok", f"{library._name}, for GigE Vision and USB3 Vision cameras")]
    answers: list[Sequence[object]] = []
    # A daemon, so that a search that hangs in the library does not keep the program from ending.
    search = threading.Thread(target=lambda: answers.append(list_aravis_cameras()), daemon=True)
    search.start()
    search.join(_DISCOVERY_S)
    if not answers:
        found = f"the search did not end within {_DISCOVERY_S:g} s"
        return [*findings, Finding("cameras", "warning", found, "unplug USB devices that hang, then try again")]
    if answers[0]:
        return [*findings, *(Finding("camera", "ok", str(camera)) for camera in answers[0])]
    advice = "if one is connected: check its power and cable, and that it is in the network of this computer"
    return [*findings, Finding("cameras", "warning", "none answers to Aravis", advice)]


def examine_ports(ports: Sequence[str] | None = None) -> list[Finding]:
    """Examine serial ports, by default those of this machine, and whether this user may open them."""
    if ports is None:
        from serial.tools.list_ports import comports

        described = {entry.device: entry.description for entry in comports()}
    else:
        described = dict.fromkeys(ports, "n/a")
    if not described:
        advice = "if the stage's controller is connected: check that its cable carries data and not only power"
        return [Finding("serial ports", "warning", "none", advice)]
    return [_examine_port(port, description) for port, description in sorted(described.items())]


def _examine_port(port: str, description: str) -> Finding:
    named = port if description == "n/a" else f"{port} ({description})"
    if not os.path.exists(port):
        return Finding("serial port", "warning", f"{named} is not there", "check the cable")
    if os.access(port, os.R_OK | os.W_OK):
        return Finding("serial port", "ok", named)
    owned = os.stat(port)
    assert grp is not None
    try:
        group = grp.getgrgid(owned.st_gid).gr_name
    except KeyError:
        group = str(owned.st_gid)
    if group == "root" or owned.st_mode & 0o060 != 0o060:
        advice = f"sudo chgrp {_USUAL_GROUP} {shlex.quote(port)} && sudo chmod 660 {shlex.quote(port)}"
    else:
        advice = _JOIN_GROUP.format(group)
    return Finding("serial port", "warning", f"{named}: no permission", advice)


FRAMES = 10  # frames grabbed to test a camera
_FRAME_S = 5.0  # longest wait for a frame, s
_BRIGHTEST_MEDIAN = 0.9  # median grey value, as a fraction of the full scale, above which an image is overexposed
_DARKEST_MEAN = 0.002  # mean grey value, as a fraction of the full scale, below which an image is dark

BEHAVIOUR = {
    1: (255, "otherwise the motor leaves its step at rest"),
    10: (1, "machine positions in the reports"),
    13: (0, "mm"),
    20: (1, "soft limits"),
    21: (0, "otherwise noise on the switch's line ends a scan"),
    22: (1, "homing, and locked until it is done"),
    23: (1, "the switch is at the lower end"),
    30: (1000, "S1000 is full power"),
    31: (0, "S0 is off"),
    32: (1, "laser mode switches the laser off at rest"),
}
"""Settings in docs/how-to/hardware-stage.md that affect laser, limits and reports, with their reasons."""

MECHANICS = {0: 10, 24: 60, 25: 600, 26: 25, 27: 2, 100: 80, 110: 900, 120: 50, 130: 750}
"""Settings in docs/how-to/hardware-stage.md for the thesis's bench; other stages differ."""


def try_camera(address: str) -> list[Finding]:
    """Open a camera, take ten frames at its own rate, and close it."""
    import numpy as np

    from uwlts.hardware.scanning import open_camera

    try:
        with open_camera(address) as camera:
            info, settings = camera.info, camera.configure()
            camera.start(faults="skip")
            frames = [camera.grab(_FRAME_S) for _ in range(FRAMES)]
            counts = camera.counts
    except Error as error:
        reason, _, advice = str(error).partition("\n")
        return [Finding("camera", "missing", f"{address}: {reason}", advice or "check power, cable, and the address")]
    took_s = frames[-1].time_s - frames[0].time_s
    rate = f"{(frames[-1].frame_id - frames[0].frame_id) / took_s:.1f} frames/s" if took_s > 0 else "all at once"
    full, images = 2**settings.bits - 1, [frame.image for frame in frames]
    median, mean = float(np.median(images)) / full, float(np.mean(images)) / full
    exposure = "" if settings.exposure_ms is None else f", exposure {settings.exposure_ms:g} ms"
    size = f"{info.width_px} x {info.height_px} px of {settings.bits} bit{exposure}"
    found = (
        f"{address}: {info.name} {info.serial}, {size}: {FRAMES} frames, {rate}, mean grey value {100 * mean:.1f} % of "
        "full scale"
    )
    faults = ", ".join(f"{number} {name}" for name, number in asdict(counts).items() if number and name != "ok")
    advice = []
    if faults:
        found += f"; frames: {faults}"
        advice.append("frames are lost or late: lower the frame rate, use jumbo packets, end other programs")
    if median > _BRIGHTEST_MEDIAN:
        advice.append("most of the image is saturated: shorten the exposure, close the aperture, shade the tank")
    if mean < _DARKEST_MEAN:
        advice.append("the images are black: expected in the dark without a laser, else check lens cap and exposure")
    return [Finding.from_advice("camera", found, "\n".join(advice))]


def try_stage(port: str) -> list[Finding]:
    """Query version, settings and state of a Grbl controller."""
    from uwlts.hardware.grbl_line import GrblLine

    try:
        with GrblLine(port) as line:
            settings, options, report = line.read_settings(), line.options(), line.status()
    except HardwareError as failed:
        advice = "see 'In case of trouble' in docs/how-to/hardware-stage.md"
        if "no permission" in str(failed):
            advice = _JOIN_GROUP.format(_USUAL_GROUP)
        return [Finding("stage", "missing", str(failed), advice)]
    build = Finding("stage", "ok", f"{port}: Grbl {line.version}, options {options or 'not given'}")
    if "V" not in options:
        found = f"{build.found}, without V: it cannot switch the laser"
        advice = "flash a Grbl with VARIABLE_SPINDLE, see docs/how-to/hardware-stage.md"
        build = Finding("stage", "missing", found, advice)
    state = _judge_state(report.state, report.pins, homing=settings.get(22, 0) != 0)
    return [build, *judge_settings(settings), state, _LASER_GUARD]


_LASER_GUARD = Finding(
    "laser",
    "ok",
    "is switched off within the exposure and 1 s if the program ends, is suspended or hangs, or its guard process "
    "ends; NOT if program and guard are killed together, or the computer freezes: then a scan's laser stays on for the "
    "exposure and 4 s. Only a hardware interlock helps sooner, or if the controller hangs: see 'Interlock' in "
    "docs/how-to/hardware-stage.md",
)


def judge_settings(settings: Mapping[int, float]) -> list[Finding]:
    """Compare the answer to ``$$``, given by number, with docs/how-to/hardware-stage.md."""
    unsafe = {number: wanted for number, (wanted, _) in BEHAVIOUR.items() if settings.get(number) != wanted}
    other = {number: wanted for number, wanted in MECHANICS.items() if settings.get(number) != wanted}
    now = {n: f"${n} is {settings[n]:g}" if n in settings else f"${n} is not there" for n in (*unsafe, *other)}
    findings = []
    if unsafe:
        found = "; ".join(f"{now[n]}, not {wanted} ({BEHAVIOUR[n][1]})" for n, wanted in unsafe.items())
        advice = f"send, one line each, what docs/how-to/hardware-stage.md asks for: {_format_settings(unsafe)}"
        if {20, 22} & unsafe.keys():
            advice += "\n$20=0 and $22=0 are right for a stage without a limit switch"
        findings.append(Finding("stage settings", "warning", found, advice))
    if other:
        found = f"other than the thesis's bench: {', '.join(now[n] for n in other)}"
        advice = f"right if your mechanics are other ones; for the thesis's bench send {_format_settings(other)}"
        findings.append(Finding("stage mechanics", "warning", found, advice))
    return findings or [Finding("stage settings", "ok", "as docs/how-to/hardware-stage.md asks for")]


def _format_settings(wanted: Mapping[int, float]) -> str:
    return " ".join(f"${number}={value:g}" for number, value in wanted.items())


def _judge_state(state: str, pins: str, *, homing: bool) -> Finding:
    """Judge the state after opening: locked until homed, unless the board's reset is disabled."""
    advice = []
    if "X" in pins:
        advice.append("the limit switch is pressed: expected at the end of the travel, else check its wiring and $5")
    if others := pins.replace("X", ""):
        advice.append(f"the inputs {others} are active (Y, Z: limits, P: probe, D, H, R: buttons): check their wiring")
    if state == "Alarm" and homing:
        found = "locked until it is homed, as after every start"
    elif state == "Idle":
        found = "idle"
    else:
        found = state
        advice.append("restart the controller; then home the stage, or unlock it where it has no limit switch")
    found += f", inputs {pins} are active" if pins else ""
    return Finding.from_advice("stage state", found, "\n".join(advice))


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
    text = f"missing: {', '.join(missing)}" if missing else "nothing that is required is missing"
    console.print(Text(f"{text}; {warnings} warning{'' if warnings == 1 else 's'}"), soft_wrap=True)
