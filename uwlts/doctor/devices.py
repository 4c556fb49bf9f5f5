"""Findings about cameras, their library and serial ports, including trials of a camera and a stage.

The stage is not moved and the laser stays off. The trial only sends queries, and Ctrl-X at the end, which switches the
laser's pin off.
"""

import os
import shlex
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict

from uwlts.doctor.machine import Finding
from uwlts.errors import Error, HardwareError, SetupError

try:
    import grp
except ImportError:
    grp = None  # Windows, where ports have no owners

# Aravis waits for answers for a second; drivers of faulty USB devices may hang.
_DISCOVERY_S = 2.5
_USUAL_GROUP = "dialout"
_JOIN_GROUP = "sudo usermod -aG {} $USER\nthen log out and in again"


def examine_cameras() -> list[Finding]:
    """Examine the library Aravis, and search for cameras for 2.5 s."""
    from uwlts.hardware.aravis import list_aravis_cameras
    from uwlts.runtime.optional_library import ARAVIS_VARIABLE, load_aravis

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
        advice = f"send, one line each, what docs/how-to/hardware-stage.md asks for: {_lines(unsafe)}"
        if {20, 22} & unsafe.keys():
            advice += "\n$20=0 and $22=0 are right for a stage without a limit switch"
        findings.append(Finding("stage settings", "warning", found, advice))
    if other:
        found = f"other than the thesis's bench: {', '.join(now[n] for n in other)}"
        advice = f"right if your mechanics are other ones; for the thesis's bench send {_lines(other)}"
        findings.append(Finding("stage mechanics", "warning", found, advice))
    return findings or [Finding("stage settings", "ok", "as docs/how-to/hardware-stage.md asks for")]


def _lines(wanted: Mapping[int, float]) -> str:
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
