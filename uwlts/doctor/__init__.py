"""Examination of this machine: what rendering, calibrating and scanning lack, and what to do about it.

Nothing here moves the stage, switches the laser on, or keeps what it writes. A part of the examination that cannot be
carried out because a library is broken becomes a finding itself.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from uwlts.doctor import devices, machine
from uwlts.doctor.machine import Finding, print_findings
from uwlts.runtime.progress import ProgressListener, unheard

__all__ = ["Finding", "examine", "print_findings"]


def examine(
    folder: Path = Path(), *, camera: str | None = None, stage: str | None = None, progress: ProgressListener = unheard
) -> list[Finding]:
    """Examine libraries, libLLVM, cameras, serial ports, permissions and speed of this machine, with advice.

    It takes about ten seconds.

    Parameters
    ----------
    folder
        Where captures are to be written; 64 MB are, and removed.
    camera
        Address of a camera to take ten frames with: gige:NAME, genicam:PRODUCER.cti or replay:PATH. Its trigger is
        switched off, its whole image read out.
    stage
        Serial port of a stage to ask for its version, settings and state. It is not moved and the laser stays off, but
        an Arduino Uno restarts: home before the next scan.
    progress
        Called with the number of parts that are done and of all parts.
    """
    parts: list[Callable[[], Sequence[Finding]]] = [
        _examine_libraries,
        machine.examine_renderer,
        partial(machine.examine, folder),
        devices.examine_cameras,
        devices.examine_producers,
        devices.examine_ports,
    ]
    if camera is not None:
        parts.append(partial(devices.try_camera, camera))
    if stage is not None:
        parts.append(partial(devices.try_stage, stage))
    findings: list[Finding] = []
    for done, part in enumerate(parts):
        progress(done, len(parts))
        try:
            findings += part()
        except ImportError as error:
            findings.append(
                Finding("examination", "missing", f"a part was left out: {error}", "repair the libraries named above")
            )
    progress(len(parts), len(parts))
    return findings


def _examine_libraries() -> list[Finding]:
    # This module needs the library packaging, whose absence is a finding as well.
    from uwlts.doctor import libraries

    return libraries.examine()
