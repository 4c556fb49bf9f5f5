"""Examination of this machine for rendering, calibration and scanning, with advice.

Nothing here moves the stage, switches the laser on, or leaves files. If a part of the examination cannot be carried out
because a library is broken, that becomes a finding.
"""

from collections.abc import Callable, Sequence
from functools import partial

from uwlts.doctor import machine
from uwlts.doctor.machine import Finding, print_findings
from uwlts.runtime.progress import ProgressListener, ignore_progress

__all__ = ["Finding", "examine", "print_findings"]


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
    parts: list[Callable[[], Sequence[Finding]]] = [
        machine.examine_libraries,
        machine.examine_renderer,
        machine.examine_cameras,
        machine.examine_ports,
    ]
    if camera is not None:
        parts.append(partial(machine.try_camera, camera))
    if stage is not None:
        parts.append(partial(machine.try_stage, stage))
    findings: list[Finding] = []
    for done, part in enumerate(parts):
        progress(done, len(parts))
        try:
            findings += part()
        except ImportError as error:
            findings.append(
                Finding(
                    "examination", "missing", f"a part was left out: {error}", "install again the library that failed"
                )
            )
    progress(len(parts), len(parts))
    return findings
