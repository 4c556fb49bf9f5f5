"""Cameras that answer, the driver libraries of others, and serial ports."""

import grp
import os
import pwd
import shlex
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from uwlts.doctor.finding import Finding
from uwlts.errors import SetupError

PRODUCERS = "GENICAM_GENTL64_PATH"
# Aravis waits a second for answers; drivers of broken USB devices may take for ever.
_DISCOVERY_S = 2.5
_USUAL_GROUP = "dialout"


def examine_cameras() -> list[Finding]:
    """The library of Aravis, and the cameras that it finds within 2.5 s."""
    from uwlts.aravis_library import load_aravis
    from uwlts.hardware.aravis import list_aravis_cameras

    try:
        library = load_aravis()
    except SetupError as error:
        fault, _, advice = str(error).partition("\nInstall it:")
        advice = "\n".join(line.strip() for line in advice.strip().splitlines())
        return [Finding("Aravis", "warning", fault, f"only for GigE Vision and USB3 Vision cameras:\n{advice}")]
    findings = [Finding("Aravis", "ok", f"{library._name}, for GigE Vision and USB3 Vision cameras")]
    answers: list[list[object]] = []
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


def examine_producers(folders: str | None = None) -> list[Finding]:
    """GenTL producers in folders separated by colons, those of the environment variable unless given."""
    named = os.environ.get(PRODUCERS, "") if folders is None else folders
    if not named:
        advice = (
            "only for cameras with a GenTL producer: install the camera maker's software, which sets it, "
            "or name the producer in the camera's address"
        )
        return [Finding("GenTL producers", "warning", f"{PRODUCERS} is not set", advice)]
    findings = []
    for folder in map(Path, filter(None, named.split(":"))):
        producers = sorted(folder.glob("*.cti"))
        if not producers:
            what = "holds no producer (*.cti)" if folder.is_dir() else "is no folder"
            findings.append(Finding("GenTL producers", "warning", f"{folder} {what}", f"correct {PRODUCERS}"))
        findings += map(_examine_producer, producers)
    return findings


def _examine_producer(path: Path) -> Finding:
    """A producer's kind is read, not run: it is a program of the camera's maker."""
    try:
        fits = _kind_of_program(path) == _kind_of_program(Path(sys.executable))
    except OSError as error:
        return Finding("GenTL producer", "warning", f"{path}: {error.strerror}", f"make {path} readable")
    if not fits:
        advice = f"install the camera maker's software for {os.uname().machine}"
        return Finding("GenTL producer", "warning", f"{path} is no library for this machine", advice)
    return Finding("GenTL producer", "ok", f"genicam:{path}")


def _kind_of_program(path: Path) -> tuple[bytes, bytes]:
    """Mark, word length and byte order of an ELF file, and the machine it is for."""
    with path.open("rb") as file:
        start = file.read(20)
    return start[:6], start[18:20]


def examine_ports(ports: Sequence[str] | None = None) -> list[Finding]:
    """Serial ports, those of this machine unless given, and whether this user may open them."""
    if ports is None:
        from serial.tools.list_ports import comports

        described = {entry.device: entry.description for entry in comports()}
    else:
        described = dict.fromkeys(ports, "n/a")
    if not described:
        advice = "if the stage's controller is connected: check its cable, and that it is no charging cable"
        return [Finding("serial ports", "warning", "none", advice)]
    return [_examine_port(port, description) for port, description in sorted(described.items())]


def _examine_port(port: str, description: str) -> Finding:
    named = port if description == "n/a" else f"{port} ({description})"
    if not os.path.exists(port):
        return Finding("serial port", "warning", f"{named} is not there", "check the cable")
    if os.access(port, os.R_OK | os.W_OK):
        return Finding("serial port", "ok", named)
    user, group = _user_name(), _group_name(os.stat(port).st_gid)
    if group == "root" or os.stat(port).st_mode & 0o060 != 0o060:
        advice = f"sudo chgrp {_USUAL_GROUP} {shlex.quote(port)} && sudo chmod 660 {shlex.quote(port)}"
        return Finding("serial port", "warning", f"{named}: no permission, nor has group {group}", advice)
    if _is_listed(user, group):
        advice = "log out and in again, or restart the computer"
        return Finding("serial port", "warning", f"{named}: no permission, group {group} is not in force yet", advice)
    advice = f"sudo usermod -aG {group} $USER\nthen log out and in again"
    return Finding("serial port", "warning", f"{named}: no permission, {user} is not in group {group}", advice)


def _is_listed(user: str, group: str) -> bool:
    try:
        return user in grp.getgrnam(group).gr_mem
    except KeyError:
        return False


def _user_name() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return f"user {os.geteuid()}"


def _group_name(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)
