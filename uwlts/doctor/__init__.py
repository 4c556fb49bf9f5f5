"""What this machine lacks for rendering, calibrating and scanning, and what to do about it.

Nothing here moves the stage, lights the laser, or keeps what it writes. Each part of the examination gives findings of
its own; one that cannot be carried out, because a library is broken, becomes a finding too.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from uwlts.doctor import devices, machine, trials
from uwlts.doctor.finding import Finding, print_findings
from uwlts.doctor.renderer import examine_renderer

__all__ = ["Finding", "examine", "print_findings"]


def examine(
    folder: Path,
    *,
    camera: str | None = None,
    stage: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Finding]:
    """Examine the machine; takes about ten seconds.

    Parameters
    ----------
    folder
        Where captures are to be written.
    camera
        Address of a camera to open and take ten frames with. Its trigger is switched off, its whole image read out.
    stage
        Serial port of a stage to talk to. Opening it restarts an Arduino Uno: home before the next scan.
    progress
        Called with the parts that are done and their number.
    """
    parts: list[Callable[[], Sequence[Finding]]] = [
        _examine_libraries, examine_renderer, partial(machine.examine, folder), devices.examine_cameras,
        devices.examine_producers, devices.examine_ports,
    ]  # fmt: skip
    if camera is not None:
        parts.append(partial(trials.try_camera, camera))
    if stage is not None:
        parts.append(partial(trials.try_stage, stage))
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
    # It needs a library itself, whose absence is a finding as well.
    from uwlts.doctor import libraries

    return libraries.examine()
